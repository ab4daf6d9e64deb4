"""Learned maps for a PLC: Structured Text (IEC 61131-3), and beside it a table per edge (CSV).

maps.st has a function block RTID_EDGE per edge, u in V along the opening and dp in Pa in, q in m3/s
and what it stands on out; maps_EDGE.csv the same flows, commands down, pressure drops across.
Bilinear, within 0.1 % of the largest flow; beyond their ends the value there.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from firmware_bridge.lookup import OUTSIDE, SHUT, STATUS
from rtid.errors import RtidError
from rtid.maps.gridded import Gridded, Tables
from rtid.plain import FloatArray
from rtid.trace.state_files import replacing

PER_LINE = 8
MOST_ELEMENTS = 32_767  # an index is INT
PLACE = """\
    {i} := 0;
    WHILE {i} < {last} AND {x} >= {nodes}[{i} + 1] DO
        {i} := {i} + 1;
    END_WHILE;
    {share} := LIMIT(0.0, ({x} - {nodes}[{i}]) / ({nodes}[{i} + 1] - {nodes}[{i}]), 1.0);"""


class NoPlcError(RtidError):
    """Maps that a PLC cannot hold; the text names the edge."""


def write_st(path: Path, tables: Tables, provenance: Mapping[str, Any]) -> None:
    """Write the function blocks, and the tables beside.  Raises NoPlcError, OSError."""
    stem = path.name.partition(".")[0]
    said = json.dumps(dict(provenance), sort_keys=True).replace("*)", "* )")
    blocks, beside = [f"(* Flow maps learned by rtid: {said} *)"], dict[str, str]()
    for g in tables:
        name = re.sub(r"\W", "_", g.name, flags=re.ASCII)
        if g.flow_m3s.size > MOST_ELEMENTS:
            raise NoPlcError(f"edge {g.name}: {g.flow_m3s.size} nodes", "a coarser grid has fewer")
        if f"{stem}_{name}.csv" in beside:
            raise NoPlcError(f"edge {g.name}: another one is called {name} too", "rename it")
        blocks += _block(name, g)
        beside[f"{stem}_{name}.csv"] = "\n".join(_table(g)) + "\n"
    for name, text in beside.items():
        with replacing(path.with_name(name)) as part:
            part.write_text(text, "utf-8")
    path.write_text("\n".join(blocks) + "\n", encoding="utf-8")


def _table(g: Gridded) -> Iterator[str]:
    yield "u_V \\ dp_Pa," + ",".join(f"{dp:.9g}" for dp in g.dp_pa)
    for u, row in zip(g.u_v, g.flow_m3s, strict=True):
        yield ",".join(f"{x:.9g}" for x in (u, *row))


def _block(name: str, g: Gridded) -> Iterator[str]:
    nu, nd = g.flow_m3s.shape
    yield ""
    yield f"FUNCTION_BLOCK RTID_{name}"
    yield "VAR_INPUT"
    yield "    u : REAL; (* opening command, V *)"
    yield "    dp : REAL; (* pressure drop, Pa *)"
    yield "END_VAR"
    yield "VAR_OUTPUT"
    yield "    q : REAL; (* flow, m3/s *)"
    yield f"    stands_on : INT; (* {', '.join(f'{k} {word}' for k, word in enumerate(STATUS))} *)"
    yield "END_VAR"
    yield "VAR"
    yield "    i : INT;"
    yield "    j : INT;"
    yield "    k : INT;"
    yield "    a : REAL;"
    yield "    b : REAL;"
    yield "END_VAR"
    yield "VAR CONSTANT"
    yield from _array("us", "REAL", g.u_v)
    yield from _array("ps", "REAL", g.dp_pa)
    yield from _array("qs", "REAL", g.flow_m3s.ravel())
    yield from _array("codes", "INT", g.code.ravel())
    yield "END_VAR"
    yield PLACE.format(i="i", x="u", nodes="us", share="a", last=nu - 2)
    yield PLACE.format(i="j", x="dp", nodes="ps", share="b", last=nd - 2)
    yield f"    k := i * {nd} + j;"
    yield "    q := (1.0 - a) * ((1.0 - b) * qs[k] + b * qs[k + 1])"
    yield f"        + a * ((1.0 - b) * qs[k + {nd}] + b * qs[k + {nd + 1}]);"
    yield "    stands_on := codes[k];"
    off = f"dp < ps[0] OR dp > ps[{nd - 1}] OR u > us[{nu - 1}]"
    yield f"    IF stands_on <> {SHUT} AND ({off}) THEN"
    yield f"        stands_on := {OUTSIDE};"
    yield "    END_IF;"
    yield "END_FUNCTION_BLOCK"


def _array(name: str, kind: str, values: FloatArray) -> Iterator[str]:
    words = [_literal(x, kind) for x in np.asarray(values, float).tolist()]
    yield f"    {name} : ARRAY[0..{len(words) - 1}] OF {kind} := ["
    for n in range(0, len(words), PER_LINE):
        end = "," if n + PER_LINE < len(words) else ""
        yield f"        {', '.join(words[n : n + PER_LINE])}{end}"
    yield "    ];"


def _literal(x: float, kind: str) -> str:
    """A number as IEC 61131-3 has it: a real one with a point, also before an exponent."""
    if kind == "INT":
        return str(round(x))
    whole, mark, power = f"{x:.9g}".partition("e")
    return (whole if "." in whole else f"{whole}.0") + (f"E{int(power)}" if mark else "")
