"""Maps that are in a controller now, as its files hold them: DCM, CDFX, or a table (CSV).

Their axes can be those of the new maps, and their values are what the new ones are held against.
A2L describes and holds no values.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from rtid.errors import RtidError
from rtid.estimator.flowmap import EdgeMap, FlowMap
from rtid.plain import FloatArray
from rtid.units import Unit, find_unit

MOST_BYTES = 64 << 20


class FlashedError(RtidError):
    """A file of maps that cannot be used; the text names the place."""


@dataclass(frozen=True, eq=False)
class FlashedMap:
    """One map: u (nu,) in V, dp (nd,) in Pa, flow (nu, nd) in m3/s."""

    name: str
    u_v: FloatArray
    dp_pa: FloatArray
    flow_m3s: FloatArray


@dataclass(frozen=True)
class FlashedDifference:
    """The new map less the flashed one at its nodes, m3/s: the largest, where, and its rms.

    share: the largest, of the largest flow of the new map.
    """

    edge: str
    largest_m3s: float
    rms_m3s: float
    share: float
    u_v: float
    dp_pa: float


@dataclass(frozen=True)
class _Raw:
    """A map as a file has it: values (len(y), len(x))."""

    name: str
    x: FloatArray
    y: FloatArray
    values: FloatArray
    units: tuple[str, str, str]  # of x, y and the values


def read_flashed(path: Path) -> tuple[FlashedMap, ...]:
    """All flow maps over command and pressure drop of a file.  Raises FlashedError, OSError."""
    readers = {".dcm": _dcm, ".cdfx": _cdfx, ".csv": _csv}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise FlashedError(
            f"{path}: no file of maps with values", "give a .dcm, .cdfx or .csv (an A2L has none)"
        )
    if path.stat().st_size > MOST_BYTES:
        raise FlashedError(f"{path}: larger than {MOST_BYTES >> 20} MB", "give one of its maps")
    try:
        maps = tuple(flashed for raw in reader(path) if (flashed := _flashed(raw)) is not None)
    except (ValueError, IndexError, KeyError, ET.ParseError) as error:
        raise FlashedError(f"{path}: cannot be read: {error}") from error
    if not maps:
        raise FlashedError(f"{path}: holds no flow over a command and a pressure drop")
    return maps


def of_edge(maps: tuple[FlashedMap, ...], edge: str) -> FlashedMap:
    """The map of an edge: by its name, or the only one there is.  Raises FlashedError."""
    words = edge.lower()
    named = [m for m in maps if re.search(rf"(^|[^a-z0-9]){re.escape(words)}([^a-z0-9]|$)",
                                          m.name.lower().replace("_", " "))]  # fmt: skip
    if named or len(maps) == 1:
        return (named or list(maps))[0]
    names = ", ".join(m.name for m in maps[:8])
    raise FlashedError(f"no map of edge {edge} among {names}", f"call it {edge}_flow there")


def difference(edge: EdgeMap, flashed: FlashedMap) -> FlashedDifference:
    """The published map of an edge less what is flashed, at the flashed nodes."""
    new = edge.flow(flashed.u_v[:, None], flashed.dp_pa[None, :])
    off = new - flashed.flow_m3s
    i, j = np.unravel_index(int(np.abs(off).argmax()), off.shape)
    largest, scale = float(off[i, j]), max(float(np.abs(new).max()), 1e-12)
    rms = float(np.sqrt(np.mean(off**2)))
    place = float(flashed.u_v[i]), float(flashed.dp_pa[j])
    return FlashedDifference(edge.name, largest, rms, abs(largest) / scale, *place)


def differences(flowmap: FlowMap, maps: tuple[FlashedMap, ...]) -> list[FlashedDifference]:
    """Of every edge."""
    return [difference(edge, of_edge(maps, edge.name)) for edge in flowmap.edges]


def _flashed(raw: _Raw) -> FlashedMap | None:
    """A raw map in SI with the command along the first axis; None where it is no flow map."""
    x, y, value = (find_unit(unit) for unit in raw.units)
    if value is None or value.dimension != "flow" or x is None or y is None:
        return None
    if raw.name.endswith("_sd"):  # of ours: how well a flow is known
        return None
    values = np.asarray(_si(value, raw.values))
    if x.dimension == "pressure":
        pairs = (_si(y, raw.y), _si(x, raw.x), values)
    elif y.dimension == "pressure":
        pairs = (_si(x, raw.x), _si(y, raw.y), values.T)
    else:
        return None
    u, dp, flow = pairs
    if not (np.diff(u) > 0).all() or not (np.diff(dp) > 0).all() or not np.isfinite(flow).all():
        raise ValueError(f"{raw.name}: axes must rise, and values be numbers")
    return FlashedMap(raw.name, u, dp, flow)


def _si(unit: Unit, values: FloatArray) -> FloatArray:
    return np.asarray(unit.factor * values)


def _dcm(path: Path) -> Iterator[_Raw]:
    text = path.read_text("utf-8", "replace")
    for block in re.findall(r"^\s*(?:GRUPPEN)?KENNFELD\s(.*?)^\s*END\b", text, re.S | re.M):
        lines = block.splitlines()
        name = lines[0].split()[0]
        units = [_quoted(block, f"EINHEIT_{axis}") for axis in "XYW"]
        x = _all(lines, "ST/X")
        y = _all(lines, "ST/Y")
        values = _all(lines, "WERT")
        yield _Raw(name, x, y, values.reshape(len(y), len(x)), (units[0], units[1], units[2]))


def _quoted(block: str, key: str) -> str:
    found = re.search(rf'{key}\s+"([^"]*)"', block)
    return found.group(1) if found else ""


def _all(lines: list[str], key: str) -> FloatArray:
    rows = (line.split()[1:] for line in lines if line.split()[:1] == [key])
    return np.array([float(word) for row in rows for word in row])


def _cdfx(path: Path) -> Iterator[_Raw]:
    if b"<!ENTITY" in path.read_bytes():
        raise ValueError("it defines entities")
    for instance in ET.parse(path).getroot().iter("SW-INSTANCE"):
        if instance.findtext("CATEGORY") != "MAP":
            continue
        axes = instance.findall("SW-AXIS-CONTS/SW-AXIS-CONT")
        content = instance.find("SW-VALUE-CONT")
        if len(axes) != 2 or content is None:
            continue
        x, y = (np.array([float(v.text or "") for v in axis.iter("V")]) for axis in axes)
        values = np.array([float(v.text or "") for v in content.iter("V")])
        units = [part.findtext("UNIT-DISPLAY-NAME", "") for part in (*axes, content)]
        name = instance.findtext("SHORT-NAME", "")
        yield _Raw(name, x, y, values.reshape(len(y), len(x)), (units[0], units[1], units[2]))


def _csv(path: Path) -> Iterator[_Raw]:
    """Drops in the first row, commands in the first column, as `rtid export maps.st` writes it."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        head, *rows = [row for row in csv.reader(file) if row]
    x = np.array([float(word) for word in head[1:]])
    numbers = np.array([[float(word) for word in row] for row in rows])
    yield _Raw(path.stem, x, numbers[:, 0], numbers[:, 1:], ("Pa", "V", "m3/s"))
