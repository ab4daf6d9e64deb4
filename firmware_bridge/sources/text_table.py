"""Tables of text as loggers and spreadsheets write them: where the numbers begin, what is above.

LabVIEW Measurement                    a preamble, or comments behind #
Zeit;Druck A;Kolbenweg                 the names
s;bar;mm                               perhaps a row of units
01.03.2026 08:00:00,002;53,9;312,4     values: a decimal comma, a time of day or a date
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.names import split_brackets
from firmware_bridge.sources.errors import LogError

LOOKED_AT, LONGEST = 200, 1 << 20  # lines in which the names are looked for, characters of each
SHOWN = 120  # characters of a row that is wrong
DELIMITERS = ";\t,|"
NULLS = ("NA", "N/A", "n/a", "NULL", "null", "#N/A")  # pyarrow knows them by itself
OF_SHEETS = ("#NV", "#DIV/0!", "#VALUE!", "#NUM!", "#REF!", "#NAME?")
MISSING = ("---", "--", "-", "?", "OL", "Overload", "None", "<NA>", "1.#INF", "-1.#INF", *OF_SHEETS)
UTF_16 = (b"\xff\xfe", b"\xfe\xff")
STAMP = re.compile(
    r"\s*(?:(\d{1,4})([-./])(\d{1,2})\2(\d{1,4})[T ]\s*)?(\d{1,3}):(\d\d):(\d\d)(?:[.,:](\d+))?"
    r"\s*(?:([AaPp])\.?[Mm]\.?)?\s*(?:Z|[+-]\d\d:?\d\d)?\s*"
)
LVM_END, LVM_UNITS = "***End_of_Header***", "Y_Unit_Label"  # of LabVIEW
COMMA = re.compile(r"\d,\d")  # a decimal one, where no comma parts the columns
DIGIT = "[0-9]"
DAY_S, CENTURY = 86_400, 2000  # of years that are written with two digits


@dataclass(frozen=True)
class Layout:
    """first: number of lines above the values; names, units ("" if unknown), a pair per column."""

    first: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    delimiter: str
    decimal: str
    encoding: str


def read(path: Path) -> tuple[list[tuple[str, Any, str]], dict[str, str]]:
    """Names, pyarrow columns, and units of a table of text; and why a column is not read, by name.

    Raises LogError, and pyarrow's errors.
    """
    import pyarrow as pa  # noqa: PLC0415  30 MB that only tables need
    from pyarrow import csv as reader  # noqa: PLC0415

    layout = layout_of(path)
    missing = [*reader.ConvertOptions().null_values, *MISSING]
    try:
        content = reader.read_csv(
            path,
            read_options=reader.ReadOptions(
                skip_rows=layout.first, column_names=_apart(layout.names), encoding=layout.encoding
            ),
            parse_options=reader.ParseOptions(delimiter=layout.delimiter),
            convert_options=reader.ConvertOptions(
                decimal_point=layout.decimal, strings_can_be_null=True, null_values=missing
            ),
        )
    except pa.ArrowInvalid as error:
        hint = "; decimal commas? Then part the columns by semicolons" * (layout.delimiter == ",")
        raise LogError(f"{path}: no table of text: {str(error)[:SHOWN]}{hint}") from error
    columns = [_without_words(column, layout.decimal) for column in content.columns]
    unread = {}
    for name, column in zip(layout.names, columns, strict=True):
        if (k := _no_number(column, layout.decimal)) is not None:
            written = column[k].as_py().strip()
            unread[name] = f"{written!r} in line {layout.first + k + 1} is no number"
    return list(zip(layout.names, columns, layout.units, strict=True)), unread


def _without_words(column: Any, decimal: str) -> Any:
    """A pyarrow column of numbers and a few words, "Error", as numbers, null for the words.

    Any other as it is: what has digits and is no number is not taken for a missing value.
    """
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.compute as pc  # noqa: PLC0415

    if not _may_be_numbers(column):
        return column
    numbers = pc.if_else(pc.match_substring_regex(column, DIGIT), column, None)
    if decimal == ",":  # a point parts thousands
        numbers = pc.replace_substring(pc.replace_substring(numbers, ".", "?"), ",", ".")
    try:
        return numbers.cast(pa.float64())
    except pa.ArrowInvalid:
        return column


def _no_number(column: Any, decimal: str) -> int | None:
    """Where the first thing with digits stands that is no number, in a column of what should be."""
    if not _may_be_numbers(column):
        return None
    other = "," if decimal == "." else "."
    written = [k for k, value in enumerate(column) if value.is_valid]
    texts = ((k, column[k].as_py()) for k in written)
    strange = (k for k, text in texts if other in text or not _is_number(text))
    return next((k for k in strange if re.search(DIGIT, column[k].as_py())), written[0])


def _may_be_numbers(column: Any) -> bool:
    """Whether at least half of a pyarrow column of text has digits, and it is no time."""
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.compute as pc  # noqa: PLC0415

    if not pa.types.is_string(column.type) or _is_stamped(column):
        return False
    has_digits = pc.sum(pc.match_substring_regex(column, DIGIT)).as_py() or 0
    return has_digits > 0 and 2 * has_digits >= len(column) - column.null_count


def _is_stamped(column: Any) -> bool:
    """Whether the first that is written in a pyarrow column of text is a time."""
    written = (value.as_py() for value in column if value.is_valid)
    return STAMP.fullmatch(next(written, "")) is not None


def rows_of(path: Path) -> tuple[Layout, list[list[str]]]:
    """A small table as it is written, row by row, decimal points in its numbers; LogError.

    Rows (n,) of fields, as many as each row has; blank ones and comments are left out.
    """
    layout = layout_of(path)
    code = "utf-16" if layout.encoding == "utf-16" else "utf-8-sig"
    lines = path.read_text(code, errors="surrogateescape").splitlines()[layout.first :]
    rows = [_fields(_decoded(line), layout.delimiter) for line in lines if line.strip()]
    if layout.decimal == ",":
        rows = [[_with_point(field) for field in row] for row in rows]
    return layout, [row for row in rows if any(row) and not row[0].startswith("#")]


def _with_point(field: str) -> str:
    return field.replace(",", ".") if _is_value(field) else field


def layout_of(path: Path) -> Layout:
    """Where a file's names stand and its values begin; LogError where it holds only comments."""
    encoding, lines = _beginning(path)
    written = [k for k, line in enumerate(lines) if line.strip() and not line.startswith("#")]
    if not written:
        raise LogError(f"{path}: holds nothing but comments")
    last = max((k for k in written[:-1] if lines[k].startswith(LVM_END)), default=-1)
    written = [k for k in written if k > last]
    tried = (_layout_from(lines, written[i:], encoding) for i in range(len(written)))
    known = next((layout for layout in tried if layout), None) or _plain(lines, written, encoding)
    return _with_labels(known, lines[: last + 1])


def _with_labels(layout: Layout, above: list[str]) -> Layout:
    """The layout with the units that LabVIEW writes into its second header, the time's aside."""
    labels = [line for line in above if line.startswith(LVM_UNITS)]
    if not labels:
        return layout
    units = ["", *_fields(labels[-1], layout.delimiter)[1:], *[""] * len(layout.names)]
    return replace(layout, units=tuple(units[: len(layout.names)]))


def _beginning(path: Path) -> tuple[str, list[str]]:
    """The encoding, as pyarrow names it, and the first lines."""
    with path.open("rb") as file:
        encoding = "utf-16" if file.read(2) in UTF_16 else "utf8"
    code = "utf-16" if encoding == "utf-16" else "utf-8-sig"
    with path.open(encoding=code, errors="surrogateescape") as file:
        lines = [file.readline(LONGEST) for _ in range(LOOKED_AT)]
    if any(len(line) == LONGEST for line in lines):
        raise LogError(f"{path}: has a line of more than a million characters: no table of text")
    if any("\0" in line for line in lines):
        raise LogError(f"{path}: holds bytes that are no text; is its suffix right?")
    return encoding, [_decoded(line) for line in lines if line]


def _decoded(line: str) -> str:
    """A line whose bytes are no UTF-8 is one of Windows."""
    return (
        line.encode("utf-8", "surrogateescape").decode("cp1252", "replace")
        if any("\udc80" <= letter <= "\udcff" for letter in line)
        else line
    )


def _layout_from(lines: list[str], at: list[int], encoding: str) -> Layout | None:
    """The layout, if the first of these lines holds the names; at: of all that are written on."""
    for delimiter in DELIMITERS:
        names, *rest = (_fields(lines[k], delimiter) for k in at[:3])
        if len(names) < 2 or _are_values(names):
            continue
        for above, values in enumerate(rest, 1):
            if not 1 < len(values) <= len(names) + (not values[-1]):  # a row may end in a delimiter
                break
            if len(values) >= len(names) - 1 and _are_values(values):
                units, titles = rest[0] if above == 2 else [], [*names, ""][: len(values)]
                return _made(lines, at[above], titles, units, delimiter, encoding)
    return None


def _plain(lines: list[str], written: list[int], encoding: str) -> Layout:
    """The first line that is written on holds the names, whatever follows."""
    header = lines[written[0]]
    delimiter = max(DELIMITERS, key=header.count)
    return _made(lines, written[0] + 1, _fields(header, delimiter), [], delimiter, encoding)


def _made(
    lines: list[str], first: int, names: list[str], units: list[str], delimiter: str, encoding: str
) -> Layout:
    """A layout; units may be fewer than names."""
    has_commas = delimiter != "," and any(COMMA.search(line) for line in lines[first:])
    given = [*(split_brackets(f"x {unit}")[1] or unit for unit in units), *[""] * len(names)]
    decimal = "," if has_commas else "."
    return Layout(first, tuple(names), tuple(given[: len(names)]), delimiter, decimal, encoding)


def _fields(line: str, delimiter: str) -> list[str]:
    return [field.strip() for field in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter))]


def _are_values(fields: list[str]) -> bool:
    """Whether half of what is written is a number or a time, at least."""
    written = [field for field in fields if field]
    return 2 * sum(map(_is_value, written)) >= max(1, len(written))


def _is_value(field: str) -> bool:
    is_one = _is_number(field) or STAMP.fullmatch(field) is not None
    return is_one or field in (*MISSING, *NULLS)


def _is_number(field: str) -> bool:
    try:
        float(field.replace(",", "."))
    except ValueError:
        return False
    return True


def _apart(names: tuple[str, ...]) -> list[str]:
    """Names for pyarrow, which wants each once."""
    return [f"{k} {name}" for k, name in enumerate(names)]


def seconds(column: Any) -> NDArray[np.float64] | None:
    """Times of day or dates (n,) of a pyarrow column, in s; None where it holds something else.

    NaN where null.  Dates are counted from 1970, hours of a day from midnight: one that is earlier
    than the one before is of the next day.
    """
    import pyarrow as pa  # noqa: PLC0415

    kind = column.type
    if pa.types.is_timestamp(kind) or pa.types.is_time(kind):
        per_s = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[kind.unit]
        ticks = column.cast(pa.int32() if kind.bit_width == 32 else pa.int64())
        times = np.asarray(ticks.cast(pa.float64(), safe=False).to_numpy()) / per_s
        return times if pa.types.is_timestamp(kind) else _over_midnight(times)
    if not pa.types.is_string(kind) or not _is_stamped(column):
        return None
    stamps = np.fromiter(_stamps(column), np.float64, len(column))
    return stamps if np.nanmax(stamps) >= DAY_S else _over_midnight(stamps)


def _stamps(column: Any) -> Iterator[float]:
    for text in column.to_pylist():
        match = STAMP.fullmatch(text) if text else None
        yield _second(match) if match else np.nan


def _second(match: re.Match[str]) -> float:
    one, _, two, three, hours, minutes, whole, part, half = match.groups()
    days = _day(one, two, three) if one else 0
    hour = int(hours) % 12 + 12 * (half in "Pp") if half else int(hours)
    return DAY_S * days + 3600 * hour + 60 * int(minutes) + float(f"{whole}.{part or 0}")


@lru_cache(maxsize=100)
def _day(one: str, two: str, three: str) -> int:
    """Days from 1970 to year-month-day, day.month.year, or month/day/year where no other is one."""
    year, month, day = (one, two, three) if len(one) == 4 else (three, two, one)
    if int(month) > 12:
        month, day = day, month
    whole_year = int(year) + (CENTURY if len(year) < 3 else 0)
    try:
        return (date(whole_year, int(month), int(day)) - date(1970, 1, 1)).days
    except ValueError:
        return 0


def _over_midnight(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Times of day (n,) that go on where a day ends; a step back of half a day is one."""
    known = np.flatnonzero(np.isfinite(times))
    steps = np.diff(times[known], prepend=times[known[:1]])
    later = times.copy()
    later[known] += DAY_S * np.cumsum(steps < -0.5 * DAY_S)
    return later
