"""Learned maps for MATLAB and Simulink: arrays (.mat), and a script of look-up tables (.m).

load maps.mat     maps.pa.u_v, maps.pa.dp_pa, maps.pa.flow_m3s, ...        SI units in the names
maps              (maps.m) pa_flow: a Simulink.LookupTable over command and pressure drop
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from firmware_bridge.lookup import STATUS
from rtid.maps.gridded import Gridded, Tables
from rtid.plain import FloatArray

PER_LINE = 8


def write_mat(path: Path, tables: Tables, provenance: Mapping[str, Any]) -> None:
    """Write a MATLAB 5 file with one struct `maps`, a field per edge."""
    from scipy.io import savemat  # noqa: PLC0415 - only where a .mat file is wanted

    edges = {_name(g.name): _arrays(g) for g in tables}
    texts = {"provenance": json.dumps(dict(provenance)), "status_codes": list(STATUS)}
    savemat(str(path), {"maps": edges | texts}, appendmat=False, oned_as="column")


def write_m(path: Path, tables: Tables, provenance: Mapping[str, Any]) -> None:
    """Write a script that makes a Simulink.LookupTable per edge, and its deviation as a matrix."""
    lines = [
        "% Flow maps learned by rtid: command in V, pressure drop in Pa, flow in m3/s; "
        "NAME_flow_sd: its standard deviation, m3/s",
        f"% {json.dumps(dict(provenance), sort_keys=True)}",
    ]
    for g in tables:
        lines += _table(g)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _arrays(g: Gridded) -> dict[str, FloatArray]:
    return {
        "u_v": g.u_v,
        "dp_pa": g.dp_pa,
        "flow_m3s": g.flow_m3s,
        "sd_m3s": g.sd_m3s,
        "status": g.code,
    }


def _table(g: Gridded) -> Iterator[str]:
    name = f"{_name(g.name)}_flow"
    yield ""
    yield f"{name} = Simulink.LookupTable;"
    for k, (field, axis, unit) in enumerate((("u", g.u_v, "V"), ("dp", g.dp_pa, "Pa")), 1):
        yield f"{name}.Breakpoints({k}).Value = [ ..."
        yield from _rows(axis)
        yield "];"
        yield f"{name}.Breakpoints({k}).FieldName = '{field}';"
        yield f"{name}.Breakpoints({k}).Unit = '{unit}';"
    yield f"{name}.Table.Unit = 'm3/s';"
    yield from _matrix(f"{name}.Table.Value", g.flow_m3s)
    yield f"{name}.StructTypeInfo.Name = '{name}_type';"
    yield from _matrix(f"{name}_sd", g.sd_m3s)


def _matrix(name: str, values: FloatArray) -> Iterator[str]:
    yield f"{name} = [ ..."
    for row in values:
        *first, last = _rows(row)
        yield from first
        yield last.removesuffix(" ...") + "; ..."
    yield "];"


def _rows(values: Iterable[float]) -> Iterator[str]:
    words = [f"{v:.9g}" for v in values]
    for start in range(0, len(words), PER_LINE):
        yield "    " + " ".join(words[start : start + PER_LINE]) + " ..."


def _name(name: str) -> str:
    """A name that MATLAB takes: letters, digits and underscores, a letter first."""
    plain = re.sub(r"\W", "_", name)
    return plain if plain[:1].isalpha() else f"edge_{plain}"
