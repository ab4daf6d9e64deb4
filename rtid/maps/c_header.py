"""Learned maps as a C99 header for the controller's compiler, with the look-up beside it.

`maps.h` holds every edge's table (`rtid.maps.lookup`) as constants, for float and for fixed point;
rtid_map.c and rtid_map_fixed.c, written beside it, evaluate them: Q(u, dp), what it stands on, and
Q^-1.  They are the same functions that maps sent by `rtid apply` are evaluated with.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.c_tables import HEADER, bill
from firmware_bridge.lookup import NO_SAFE_BAND, RISING, STATUS, Table
from rtid.errors import RtidError
from rtid.estimator.flowmap import FlowMap
from rtid.maps.lookup import ERROR_PERCENT, Sampled, sample
from rtid.model import Machine
from rtid.plain import IntArray
from rtid.trace.state_files import replacing

SUFFIX = ".h"
BESIDE = (
    "rtid_map.h", "rtid_map.c", "rtid_map_fixed.h", "rtid_map_fixed.c", "rtid_map_search.h",
    "rtid_version.h",
)  # fmt: skip
MICROVOLT, ROOT, FLOW = 1e6, 64.0, 1e9 * 65_536  # units of the fixed tables
INT32_MAX = 2**31 - 1
WIDTH, PREFIX = 100, "rtid_edge_"


class NoHeaderError(RtidError):
    """Maps that cannot become C; the text names the edge."""


def write_header(
    path: Path,
    model: Machine,
    flow_map: FlowMap,
    provenance: Mapping[str, Any],
    error_percent: float = ERROR_PERCENT,
) -> tuple[Sampled, ...]:
    """Write the header, and the look-up beside it; what each table is off by.

    Raises NoHeaderError, NoTableError, OSError.
    """
    sampled = tuple(sample(e, flow_map[e.name], error_percent) for e in model.maps)
    texts = {path: "\n".join(_lines(path, sampled, provenance)) + "\n"}
    texts |= {path.with_name(n): HEADER.with_name(n).read_text("utf-8") for n in BESIDE}
    for file, text in texts.items():
        with replacing(file) as part:
            part.write_text(text, "utf-8")
    return sampled


def _lines(path: Path, sampled: Iterable[Sampled], provenance: Mapping[str, Any]) -> Iterator[str]:
    guard = re.sub(r"\W", "_", path.name).upper()
    origin = json.dumps(dict(provenance), sort_keys=True).replace("*/", "* /")
    yield "/* Flow maps learned by rtid, as look-up tables: do not edit.  Compile rtid_map.c with"
    yield " * it, or rtid_map_fixed.c for integers:"
    yield " *     int stands_on = rtid_map_flow(&rtid_edge_NAME, u_in_v, dp_in_pa, &q);"
    yield " *     int stands_on = rtid_map_command(&rtid_edge_NAME, q_in_m3_per_s, dp_in_pa, &u);"
    yield " * What a flow stands on: " + ", ".join(f"{k} {word}" for k, word in enumerate(STATUS))
    yield " * NAME_u: V; NAME_s: sign(dp) sqrt |dp|, sqrt(Pa); NAME_q: m3/s over the scale"
    yield f" * {origin}"
    yield f" * Bill of material: {bill(HEADER.with_name(name) for name in BESIDE)}"
    yield " */"
    yield f"#ifndef {guard}"
    yield f"#define {guard}"
    yield ""
    yield '#include "rtid_map.h"'
    yield '#include "rtid_map_fixed.h"'
    used: set[str] = set()
    for edge_sample in sampled:
        name = PREFIX + re.sub(r"\W", "_", edge_sample.edge)
        if name in used:
            raise NoHeaderError(
                f"edge {edge_sample.edge}: another one has the same name in C", "rename it"
            )
        used.add(name)
        yield from _edge(name, edge_sample)
    yield ""
    yield "#endif"


def _edge(name: str, sampled: Sampled) -> Iterator[str]:
    largest, rms = 6e4 * sampled.error_max_m3s, 6e4 * sampled.error_rms_m3s
    yield ""
    t = sampled.table
    yield f"/* Edge {sampled.edge}: {len(t.w_v)} commands, {len(t.s)} roots of the pressure drop."
    yield f" * Off by {largest:.2g} L/min from the map at most, rms {rms:.2g}. */"
    yield from float_map(name, t)
    yield from _fixed(name, t)


def float_map(name: str, t: Table) -> Iterator[str]:
    """A table as the constant `name` of type rtid_map (c/rtid_map.h), line by line."""
    status = t.status.copy()
    status[0] |= np.where(t.rising, RISING, 0).astype(np.uint8)
    yield from _array("float", f"{name}_u", (_float(x) for x in t.w_v))
    yield from _array("float", f"{name}_s", (_float(x) for x in t.s))
    yield from _array("int16_t", f"{name}_q", map(str, t.counts.ravel().tolist()))
    yield from _array("uint8_t", f"{name}_status", map(str, status.ravel().tolist()))
    safe = "-3.402823466e+38f" if t.safe_band_v == NO_SAFE_BAND else _float(t.safe_band_v)
    yield f"static const rtid_map {name} = {{"
    yield f"    {name}_u, {name}_s, {name}_q, {name}_status, {_float(t.scale)}, {safe},"
    yield f"    {len(t.w_v)}, {len(t.s)}, {t.direction}}};"


def _fixed(name: str, t: Table) -> Iterator[str]:
    u, s = _whole(name, t.w_v, MICROVOLT), _whole(name, t.s, ROOT)
    (scale,) = _whole(name, np.array([t.scale]), FLOW)
    declared = t.safe_band_v != NO_SAFE_BAND
    safe = str(round(t.safe_band_v * MICROVOLT)) if declared else "INT32_MIN"
    yield from _array("int32_t", f"{name}_fixed_u", map(str, u.tolist()))
    yield from _array("int32_t", f"{name}_fixed_s", map(str, s.tolist()))
    yield f"static const rtid_map_fixed {name}_fixed = {{"
    yield f"    {name}_fixed_u, {name}_fixed_s, {name}_q, {name}_status, {scale}, {safe},"
    yield f"    {len(t.w_v)}, {len(t.s)}, {t.direction}}};"


def _whole(name: str, values: NDArray[Any], unit: float) -> IntArray:
    whole = np.rint(values.astype(float) * unit).astype(np.int64)
    if (np.abs(whole) > INT32_MAX).any() or (np.diff(whole) < 1).any() or not whole.any():
        raise NoHeaderError(
            f"edge {name.removeprefix(PREFIX)}: its numbers do not fit into 32 bits",
            "commands are in microvolts there; scale the command",
        )
    return whole


def _float(x: float) -> str:
    text = f"{float(np.float32(x)):.9g}"
    return text + ("f" if any(mark in text for mark in ".e") else ".0f")


def _array(kind: str, name: str, values: Iterable[str]) -> Iterator[str]:
    yield f"static const {kind} {name}[] = {{"
    line = "   "
    for value in values:
        if len(line) + len(value) + 2 > WIDTH:
            yield line
            line = "   "
        line += f" {value},"
    yield line
    yield "};"
