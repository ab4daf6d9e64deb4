"""Tables as files: Parquet, text and MATLAB .mat.

value = offset + scale * number, with scale, offset and unit from the field metadata of a Parquet
column (1, 0 and unknown elsewhere).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.sources import mat, text_table
from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.table import NUMBER_BYTES, Column, Table, is_time, named_columns
from firmware_bridge.sources.unpacked import Budget


def read_parquet(path: Path) -> Table:
    """A Parquet file; LogError if it unpacks to too much, else what pyarrow raises."""
    import pyarrow.parquet as pq  # noqa: PLC0415  30 MB that only tables need

    file = pq.ParquetFile(path)
    fields = [field for field in file.schema_arrow if _is_number(field.type)]
    stamps = [field.name for field in file.schema_arrow if _is_stamp(field.type)]
    Budget(path).take(file.metadata.num_rows * NUMBER_BYTES * (len(fields) + len(stamps) + 1))
    result: list[Column] = []
    for entry in fields:
        numbers = _numbers(file.read([entry.name]).column(entry.name))
        meta = {k.decode().lower(): v.decode() for k, v in (entry.metadata or {}).items()}
        scale, offset = float(meta.get("scale", 1.0)), float(meta.get("offset", 0.0))
        with np.errstate(over="ignore", invalid="ignore"):  # damaged ones: missing values
            values = offset + scale * numbers
        result.append((entry.name, values, meta.get("unit") or meta.get("units", "")))
    result += _timed((name, file.read([name]).column(name), "") for name in stamps)
    return named_columns(path, result)


def read_text(path: Path) -> Table:
    """A table of text: .csv, .tsv, .txt; where its numbers begin is found, as is the delimiter."""
    columns, unread = text_table.read(path)
    return replace(named_columns(path, _timed(columns)), unread=unread)


def read_mat(path: Path) -> Table:
    """The vectors of a MATLAB file up to version 7 that are as long as its time, or the longest.

    LogError for a later version, and where there are no two of them.
    """
    try:
        vectors, unread = mat.vectors(path)
    except NotImplementedError:
        raise LogError(f"{path}: a MATLAB 7.3 file; save it with save(..., '-v7')") from None
    except ValueError as error:
        remedy = "save it with save(..., '-v7')"
        raise LogError(f"{path}: no readable MATLAB file ({error}); {remedy}") from error
    times = [len(values) for name, values in vectors.items() if is_time(name)]
    longest = max(times or map(len, vectors.values()), default=0)
    columns = [(k, v, "") for k, v in vectors.items() if len(v) == longest]
    table = replace(named_columns(path, columns), unread=unread)
    if len(columns) < 2 and unread:
        remedy = "save one vector for each signal: save('run.mat', 't', 'u', 'x', 'p_a', ...)"
        raise LogError(f"{path}: holds {len(columns)} vectors{table.unread_said}; {remedy}")
    return table


def _timed(columns: Iterable[tuple[str, Any, str]]) -> Iterator[Column]:
    """Titles, columns (n,) and units of numbers, and then of dates and times of day: in s.

    A time that is a number goes before one that is written: it may be the finer one.
    """
    others = []
    for title, column, unit in columns:
        if _is_number(column.type):
            yield title, _numbers(column), unit
        else:
            others.append((title, column))
    for title, column in others:
        if (times := text_table.seconds(column)) is not None:
            yield title, times, "s"


def _is_number(kind: Any) -> bool:
    """Whether a pyarrow type is one of numbers."""
    from pyarrow import types  # noqa: PLC0415

    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind))


def _is_stamp(kind: Any) -> bool:
    """Whether a pyarrow type is a date with a time, or a time of day."""
    from pyarrow import types  # noqa: PLC0415

    return bool(types.is_timestamp(kind) or types.is_time(kind))


def _numbers(column: Any) -> NDArray[np.float64]:
    """A pyarrow column of numbers as float64, NaN where null."""
    import pyarrow as pa  # noqa: PLC0415

    return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False))
