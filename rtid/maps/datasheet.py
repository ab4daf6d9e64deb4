"""Reference maps from CSV data sheets, units in the header; lines with # are comments.

Semicolons, tabulators, decimal commas and a row of units are read as in a table of samples.

abs_u_V,K                          one gain for all edges, Q = K sqrt(dp)
abs_u_V,K_PA,K_AT,K_PB,K_BT        one gain per edge, m3/s/sqrt(Pa)
dp_MPa,u_V,Q_l_min                 long form (or flow_l_min), optionally with a column edge or valve
edge,u_%,over,Q_m/s                of a plant without pressures, as `rtid export` writes it
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from firmware_bridge.names import split_brackets
from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.text_table import rows_of
from rtid.compare.reference import ANY_EDGE, GainTable, RateTable, ReferenceMap
from rtid.errors import RtidError, door
from rtid.estimator.orifice import root
from rtid.plain import BoolArray, FloatArray
from rtid.units import COMMAND_DIMENSIONS, Unit, find_unit, split_name


class DataSheetError(RtidError):
    """A data sheet that cannot be used; the text names file, line or column."""


@door
def read_reference(path: str | Path) -> ReferenceMap:
    """A reference map from a CSV data sheet.  Raises DataSheetError, OSError."""
    path = Path(path)
    header, lines = _read_csv(path)
    plain = [name.casefold() for name in header]
    gains = [k for k, name in enumerate(plain) if name == "k" or name.startswith("k_")]
    if any(_is(name, "over") for name in header):
        return ReferenceMap(path.stem, _rates(path, header, lines))
    tables = _gain_columns(path, header, lines, gains) if gains else _long(path, header, lines)
    return ReferenceMap(path.stem, tables)


def _read_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    """Names, with the unit that a row below them gives, and the fields of each line of numbers."""
    try:
        layout, rows = rows_of(path)
    except (csv.Error, UnicodeError, LogError) as error:
        raise DataSheetError(f"{path}: no data in a CSV table ({error})") from error
    if not rows:
        raise DataSheetError(f"{path}: no data", "a header line and at least one line of numbers")
    named = zip(layout.names, layout.units, strict=True)
    header = [f"{name} [{unit}]" if unit else name for name, unit in named]
    for k, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise DataSheetError(f"{path}: data line {k} has {len(row)} of {len(header)} columns")
    return header, rows


def _gain_columns(
    path: Path, header: list[str], lines: list[list[str]], gains: list[int]
) -> dict[str, GainTable]:
    u, unit = _column(path, header, COMMAND_DIMENSIONS, "u", "abs_u")
    _require_command(path, header[u], unit)
    w_v = _numbers(path, header, lines, u) * unit.factor
    order = np.argsort(w_v)
    if len(w_v) < 2 or not (np.diff(w_v[order]) > 0).all():
        raise DataSheetError(f"{path}: {header[u]} needs two or more values, each only once")
    tables = {}
    for k in gains:
        edge = header[k].partition("_")[2].casefold() or ANY_EDGE
        gain = _numbers(path, header, lines, k)[order]
        tables[edge] = GainTable(w_v[order], np.ones(1), gain[:, None])
    return tables


def _long(path: Path, header: list[str], lines: list[list[str]]) -> dict[str, GainTable]:
    u, u_unit = _column(path, header, COMMAND_DIMENSIONS, "u", "abs_u")
    p, p_unit = _column(path, header, ("pressure",), "dp")
    q, q_unit = _column(path, header, ("flow",), "Q", "flow")
    _require_command(path, header[u], u_unit)
    w_v = _numbers(path, header, lines, u) * u_unit.factor
    dp_pa = _numbers(path, header, lines, p) * p_unit.factor
    q_m3s = _numbers(path, header, lines, q) * q_unit.factor
    tables = {}
    for edge, rows in _by_edge(header, lines):
        of = rows & (dp_pa != 0)
        tables[edge] = _gains(path, w_v[of], dp_pa[of], q_m3s[of])
    return tables


def _by_edge(header: list[str], lines: list[list[str]]) -> Iterator[tuple[str, BoolArray]]:
    """Every edge of a long table, and which lines are its own."""
    plain = [name.casefold() for name in header]
    edges = [ANY_EDGE] * len(lines)
    named = next((plain.index(word) for word in ("edge", "valve") if word in plain), None)
    if named is not None:
        edges = [row[named].strip().casefold() for row in lines]
    for edge in dict.fromkeys(edges):
        yield edge, np.array([name == edge for name in edges])


def _rates(path: Path, header: list[str], lines: list[list[str]]) -> dict[str, RateTable]:
    """The long form of a plant without pressures, over a second quantity of any unit."""
    w, over, q = (_scaled(path, header, lines, stem) for stem in ("u", "over", "Q"))
    return {edge: _rate_table(path, w[of], over[of], q[of]) for edge, of in _by_edge(header, lines)}


def _scaled(path: Path, header: list[str], lines: list[list[str]], stem: str) -> FloatArray:
    """A column in SI; as it stands where its unit is not known, or none."""
    columns = [k for k, name in enumerate(header) if _is(name, stem)]
    if len(columns) != 1:
        raise DataSheetError(
            f"{path}: no single column {stem} among {', '.join(header)}", "as `rtid export` has it"
        )
    unit = find_unit(split_name(header[columns[0]])[1])
    values = _numbers(path, header, lines, columns[0])
    return values * unit.factor + unit.offset if unit else values


def _rate_table(path: Path, w: FloatArray, over: FloatArray, q: FloatArray) -> RateTable:
    us, i = np.unique(w, return_inverse=True)
    ends, j = np.unique(over, return_inverse=True)
    if len(us) < 2:
        raise DataSheetError(f"{path}: rates at one command only", "give two commands or more")
    rate = np.full((len(us), len(ends)), np.nan)
    rate[i, j] = q
    return RateTable(us, ends, rate)


def _gains(path: Path, w_v: FloatArray, dp_pa: FloatArray, q_m3s: FloatArray) -> GainTable:
    """Scattered flows as a table of gains; sign-symmetric, so |dp| counts."""
    us, i = np.unique(w_v, return_inverse=True)
    ps, j = np.unique(np.abs(dp_pa), return_inverse=True)
    if len(us) < 2:
        raise DataSheetError(f"{path}: flows at one command only", "give two commands or more")
    gain = np.full((len(us), len(ps)), np.nan)
    gain[i, j] = q_m3s / root(dp_pa)
    return GainTable(us, ps, gain)


def _column(
    path: Path, header: list[str], dimensions: tuple[str, ...], *stems: str
) -> tuple[int, Unit]:
    """The column of a quantity and its unit, e.g. dp_MPa, dp [MPa] or Q_calibrated_l_min."""
    columns = [k for k, name in enumerate(header) if any(_is(name, stem) for stem in stems)]
    if len(columns) > 1:
        columns = [k for k in columns if "calibrated" in header[k] or "reference" in header[k]]
    if len(columns) != 1:
        raise DataSheetError(
            f"{path}: no single column {stems[0]}_UNIT among {', '.join(header)}",
            "name the columns u_V, dp_MPa and Q_l_min, or abs_u_V and K",
        )
    name = header[columns[0]]
    unit = find_unit(split_name(name, dimensions)[1])
    if unit is None:
        raise DataSheetError(
            f"{path}: column {name!r} names no unit", "write e.g. u_V, dp_MPa, Q_l_min"
        )
    return columns[0], unit


def _is(title: str, stem: str) -> bool:
    """Whether a column is called so, whatever stands behind it."""
    name, stem = split_brackets(title)[0].casefold(), stem.casefold()
    return name == stem or name.startswith((f"{stem}_", f"{stem} "))


def _require_command(path: Path, name: str, unit: Unit) -> None:
    if unit.dimension not in COMMAND_DIMENSIONS:
        raise DataSheetError(f"{path}: column {name!r} is no command", "write u_V, u_mA or u_pct")


def _numbers(path: Path, header: list[str], lines: list[list[str]], column: int) -> FloatArray:
    """One column; NA and an empty field are NaN in a flow, an error elsewhere."""
    out = np.empty(len(lines))
    for k, row in enumerate(lines):
        text = row[column].strip()
        missing = text.casefold() in ("", "na", "nan") and header[column][0] in "QqKFf"
        try:
            out[k] = np.nan if missing else float(text)
        except ValueError:
            where = f"{path}: data line {k + 2}, column {header[column]!r}"
            raise DataSheetError(f"{where}: {text!r} is no number") from None
    return out
