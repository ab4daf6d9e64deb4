"""Tables of samples: Parquet, CSV and MATLAB .mat; one row per sample, one column per signal.

value = offset + scale * number, with scale, offset and unit from the field metadata of a Parquet
column (1, 0 and unknown elsewhere).  A CSV header may carry the unit: "p_a [MPa]", "p_a (MPa)".
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.config import Assembly, SignalSource
from firmware_bridge.frames import add_counts
from firmware_bridge.samples import GAP, ROW, Samples
from firmware_bridge.sources.errors import LogError

TIME_NAMES = ("t", "time", "t_s", "time_s", "timestamp", "zeit")
TIME_UNITS = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0}
_UNIT = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]\s*$")


@dataclass(frozen=True)
class Table:
    """Named columns float64 (n,) in the units of the file, and these units ("" if unknown)."""

    path: Path
    columns: dict[str, NDArray[np.float64]]
    units: dict[str, str]

    def column(self, name: str) -> NDArray[np.float64]:
        """One column; LogError with the nearest name if there is none such."""
        if name not in self.columns:
            close = get_close_matches(name, list(self.columns), 1, 0.5)
            hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(self.columns)}"
            raise LogError(f"{self.path}: no numeric column {name!r}; {hint}")
        return self.columns[name]

    def t_us(self) -> NDArray[np.int64]:
        """Time stamps, int64 (n,) microseconds; LogError if no column looks like time."""
        for name in self.columns:
            if name.lower() in TIME_NAMES:
                unit = self.units.get(name, "")
                if unit not in TIME_UNITS:
                    raise LogError(f"{self.path}: time column {name!r} has unit {unit!r}; use s")
                t = self.column(name) * (TIME_UNITS[unit] * 1e6)
                return np.where(np.isfinite(t), np.rint(t), np.iinfo(np.int64).min).astype(np.int64)
        raise LogError(f"{self.path}: no time column; name one of {', '.join(TIME_NAMES)}")


def read_table(path: str | Path) -> Table:
    """Read a .parquet, .csv, .tsv, .txt or .mat file; LogError if it cannot be."""
    path = Path(path)
    readers = {".parquet": _parquet, ".csv": _csv, ".tsv": _csv, ".txt": _csv, ".mat": _mat}
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise LogError(f"{path}: unknown suffix {suffix!r}; known are {', '.join(readers)}")
    if not path.is_file() or path.stat().st_size == 0:
        raise LogError(f"{path}: no such file, or it is empty")
    try:
        table = readers[suffix](path)
    except LogError:
        raise
    except Exception as error:  # pyarrow and scipy raise whatever a damaged file causes
        raise LogError(f"{path}: not a readable {suffix} table: {error}") from error
    if not table.columns:
        raise LogError(f"{path}: holds no numeric column")
    return table


def to_samples(table: Table, assembly: Assembly) -> tuple[Samples, dict[str, int]]:
    """Samples of the roles in `assembly` (signal = column), and refusals by reason.

    Rows with a missing value ("not_available") or whose time does not grow ("out_of_order") are
    refused.  A step of more than 1.5 median steps, and the first row, carry GAP; all carry ROW.
    """
    t_us = table.t_us()
    values = np.column_stack([_role(table, s, len(t_us)) for s in assembly.signals])
    counts: dict[str, int] = {}
    finite = np.isfinite(values).all(axis=1)
    before = np.maximum.accumulate(np.concatenate([[np.iinfo(np.int64).min], t_us[:-1]]))
    later = t_us > before
    add_counts(counts, {"not_available": int((~finite).sum())})
    add_counts(counts, {"out_of_order": int((finite & ~later).sum())})
    keep = finite & later
    t_us, values = t_us[keep], values[keep]
    flags = np.full(len(t_us), ROW, np.uint8)
    if len(t_us) > 1:
        steps = np.diff(t_us)
        gaps = steps > 1.5 * np.median(steps)
        flags[1:][gaps] |= GAP
        add_counts(counts, {"gap": int(gaps.sum())})
    flags[:1] |= GAP
    return Samples(tuple(s.name for s in assembly.signals), t_us, values, flags), counts


def _role(table: Table, source: SignalSource, n: int) -> NDArray[np.float64]:
    if source.constant is not None:
        return np.full(n, source.constant)
    column = table.column(source.signal)
    if source.table is not None:
        return np.interp(column, *source.table)
    return source.factor * column + source.offset


def _parquet(path: Path) -> Table:
    import pyarrow.parquet as pq  # noqa: PLC0415  30 MB that only tables need

    content = pq.read_table(path)
    columns, units = {}, {}
    for field, column in zip(content.schema, content.columns, strict=True):
        numbers = _numbers(column)
        if numbers is None:
            continue
        meta = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
        scale, offset = float(meta.get("scale", 1.0)), float(meta.get("offset", 0.0))
        columns[field.name], units[field.name] = offset + scale * numbers, meta.get("unit", "")
    return Table(path, columns, units)


def _csv(path: Path) -> Table:
    from pyarrow import csv  # noqa: PLC0415

    n_comments, header, first = _csv_head(path)
    delimiter = max(";\t,", key=header.count)
    decimal = "," if delimiter != "," and "," in first else "."
    content = csv.read_csv(
        path,
        read_options=csv.ReadOptions(skip_rows=n_comments),
        parse_options=csv.ParseOptions(delimiter=delimiter),
        convert_options=csv.ConvertOptions(decimal_point=decimal, strings_can_be_null=True),
    )
    columns, units = {}, {}
    for title, column in zip(content.column_names, content.columns, strict=True):
        name, unit = _split_unit(title)
        numbers = _numbers(column)
        if numbers is not None:
            columns[name], units[name] = numbers, unit
    return Table(path, columns, units)


def _csv_head(path: Path) -> tuple[int, str, str]:
    """Number of leading comment lines (#), the header, and the first line of numbers."""
    n_comments = 0
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for line in file:
            if not line.startswith("#"):
                return n_comments, line, file.readline()
            n_comments += 1
    raise LogError(f"{path}: holds nothing but comments")


def _split_unit(title: str) -> tuple[str, str]:
    found = _UNIT.match(title.strip())
    return (found["name"], found["unit"].strip()) if found else (title.strip(), "")


def _numbers(column: Any) -> NDArray[np.float64] | None:
    """A pyarrow column as float64, NaN where null; None if it holds no numbers."""
    import pyarrow as pa  # noqa: PLC0415

    kind = column.type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
        return None
    return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False))


def _mat(path: Path) -> Table:
    from scipy.io import loadmat  # noqa: PLC0415

    try:
        content: Mapping[str, Any] = loadmat(path, squeeze_me=True)
    except NotImplementedError:
        raise LogError(f"{path}: a MATLAB 7.3 file; save it with save(..., '-v7')") from None
    vectors = {
        name: np.asarray(value, np.float64)
        for name, value in content.items()
        if isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "iufb"
    }
    longest = max((len(value) for value in vectors.values()), default=0)
    return Table(path, {k: v for k, v in vectors.items() if len(v) == longest}, {})
