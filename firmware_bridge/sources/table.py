"""Tables of samples: one row per sample, one column per signal, whatever file they came in.

The name of a column may carry the unit in brackets in every kind of file, "p_a [MPa]" or
"p_a (MPa)"; the unit in a file's metadata goes before it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.config import Assembly, SignalSource
from firmware_bridge.frames import add_counts
from firmware_bridge.names import split_brackets, split_unit
from firmware_bridge.samples import GAP, ROW, Samples
from firmware_bridge.sources.errors import LogError

NUMBER_BYTES, DAY_S = 8, 86_400.0
MINUS = " - "  # between the names of two columns
MOST_US = 2.0**62  # of a time stamp
PERIODS, OFTEN = 1.5, 0.95  # of the usual step: more is a gap; share of the steps that are usual
IN_TURN = 0.2  # share of blank rows, from which on a column is written in turn with others
JUMP, JUMPS = "command_jump", 10.0  # counter of them; times what is usual of a moving command
APART = "in_turn"  # counter of the rows that give what they tell to others
FALLS = 0.3  # share of rows that are earlier than the one before: they are in no order
ALIKE = 0.1  # of a step: so near to a multiple it is one
TIME_NAMES = ("t", "time", "timestamp", "zeit")  # with or without a unit behind: t_ms, time_s
TIMES = {*TIME_NAMES, "datetime", "date_time", "uhrzeit", "zeitstempel", "elapsed_time", "x_value"}
TIMES |= {"temps", "tempo", "tiempo", "czas", "\u65f6\u95f4"}
TIME_UNITS = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0}
TIME_UNITS |= {"sec": 1.0, "seconds": 1.0, "msec": 1e-3, "usec": 1e-6, "h": 3600.0}
TIME_UNITS |= {"d": DAY_S, "days": DAY_S}  # as spreadsheets keep a date
TIME_UNITS["\N{GREEK SMALL LETTER MU}s"] = 1e-6
WRAPS = 2.0**16, 2.0**32  # ticks after which a counter begins again
NEAR = 10.0  # usual steps: what goes on behind the end of a counter does so within

Column = tuple[str, NDArray[np.float64], str]  # title, values (n,) and unit, "" if unknown


@dataclass(frozen=True)
class Table:
    """Named columns float64 (n,) in the units of the file, and these units ("" if unknown).

    unread: why a column that may be meant is none of them, by its title.
    """

    path: Path
    columns: dict[str, NDArray[np.float64]]
    units: dict[str, str]
    unread: Mapping[str, str] = field(default_factory=dict)

    def known_as(self, name: str) -> str:
        """The name under which a column is kept; LogError with the nearest name if there is none.

        A column may be asked for with its unit as the file writes it, "p_s [Pa]".  A difference is
        kept as its first column.
        """
        for known in (name, split_brackets(name)[0], *self._difference(name)[:1]):
            if known in self.columns:
                return known
        for title, why in self.unread.items():
            if split_brackets(title)[0] == split_brackets(name)[0]:
                raise LogError(f"{self.path}: column {title!r}: {why}")
        close = get_close_matches(name, list(self.columns), 1, 0.5)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(self.columns)}"
        raise LogError(f"{self.path}: no numeric column {name!r}; {hint}")

    def column(self, name: str) -> NDArray[np.float64]:
        """One column (n,), its unit in `units`; LogError with the nearest name if there is none.

        "out - in" is the difference of two: of a valve with a coil for either direction.
        """
        both = self._difference(name)
        if both and name not in self.columns:
            return self.columns[both[0]] - self.columns[both[1]]
        return self.columns[self.known_as(name)]

    def _difference(self, name: str) -> tuple[str, ...]:
        """The two columns of "out - in", whose names may hold a minus too; () of anything else."""
        parts = name.split(MINUS)
        halves = ((MINUS.join(parts[:k]), MINUS.join(parts[k:])) for k in range(1, len(parts)))
        return next((pair for pair in halves if all(one in self.columns for one in pair)), ())

    @property
    def unread_said(self) -> str:
        """What is not read, and why, as the end of a sentence; "" where all is."""
        said = ", ".join(f"{title} ({why})" for title, why in self.unread.items())
        return f"; not read: {said}" if said else ""

    def time_name(self) -> str | None:
        """The column that looks like time, by its name; None if none does."""
        return next((name for name in self.columns if is_time(name)), None)

    def time_unit(self, name: str) -> str:
        """Unit of a column that holds the time, from the file or its name; "" if neither says."""
        name = self.known_as(name)
        return self.units.get(name, "") or _split_time(name)[1]

    def seconds(self, name: str, unit: str | None = None) -> NDArray[np.float64]:
        """A column of times in s, float64 (n,), from the unit given or its own; LogError.

        What begins again, a counter or the time of day, goes on.
        """
        unit = self.time_unit(name) if unit is None else unit
        if unit.lower() not in TIME_UNITS:
            raise LogError(f"{self.path}: time column {name!r} has unit {unit!r}; use s")
        return unwrapped(self.column(name), TIME_UNITS[unit.lower()])

    def t_us(self) -> NDArray[np.int64]:
        """Time stamps, int64 (n,) microseconds; LogError if no column looks like time."""
        name = self.time_name()
        if name is None:
            raise LogError(f"{self.path}: no time column; name one of {', '.join(TIME_NAMES)}")
        t = 1e6 * self.seconds(name)
        usable = np.abs(t) < MOST_US  # never of NaN
        return np.where(usable, np.rint(t), np.iinfo(np.int64).min).astype(np.int64)


def unwrapped(ticks: NDArray[np.float64], tick_s: float) -> NDArray[np.float64]:
    """Times (n,) in s of ticks (n,), each tick_s long, that may begin again: they go on.

    After 2^16 or 2^32 ticks, as counters do, or a day, as the time since midnight does: a step back
    by that, less a usual step or a few, is no row out of its order.
    """
    known = np.flatnonzero(np.isfinite(ticks))
    steps = np.diff(ticks[known], prepend=ticks[known[:1]])
    ahead = steps[steps > 0.0]
    if not len(ahead) or len(ahead) == len(steps) - 1:
        return ticks * tick_s
    later, most = np.zeros(len(steps)), NEAR * float(np.median(ahead))
    for turn in (*WRAPS, DAY_S / tick_s):
        goes_on = (steps < 0.0) & (steps + turn > 0.0) & (steps + turn <= most)
        later[goes_on & (later == 0.0)] = turn
    result = ticks.copy()
    result[known] += np.cumsum(later)
    return result * tick_s


def is_time(name: str) -> bool:
    """Whether a column looks like time: t, time_s, Zeit, t_ms."""
    return _split_time(name)[0].lower().replace(" ", "_") in TIMES


def _split_time(name: str) -> tuple[str, str]:
    """Name and unit of a time; a d says days in brackets alone: t_d is a dead time as well."""
    named = TIME_UNITS.keys() - {"", "d"}
    return split_unit(name, lambda unit, _stem: unit.lower() in named)


def to_samples(table: Table, assembly: Assembly) -> tuple[Samples, dict[str, int]]:
    """Samples of the roles in `assembly` (signal = column), and refusals by reason.

    Rows with a missing value ("not_available") or whose time does not grow ("out_of_order") are
    refused.  A step that is a gap (`longest_step`), and the first row, carry GAP; all carry ROW.
    So does what a command that is a sample of a faster one jumps to ("command_jump"): when, nobody
    knows.
    Of rows that tell signals in turn those are taken that tell the sensor which comes most seldom;
    the others ("in_turn") say what is between them.
    """
    t_us = table.t_us()
    _refuse_falling(table.path, t_us)
    columns = [_role(table, s, len(t_us)) for s in assembly.signals]
    at = _rows(columns, [s.command for s in assembly.signals])
    each = zip(columns, assembly.signals, strict=True)
    values = np.column_stack([_at_rows(t_us, column, at, s) for column, s in each])
    jumped = np.zeros(len(at), bool)
    for column, signal in zip(columns, assembly.signals, strict=True):
        if signal.command and signal.hold != "zero":
            jumped[1:] |= jumps(between(t_us, column)[at])
    counts: dict[str, int] = {}
    add_counts(counts, {APART: len(t_us) - len(at)})
    t_us = t_us[at]
    finite = np.isfinite(values).all(axis=1)
    before = np.maximum.accumulate(np.concatenate([[np.iinfo(np.int64).min], t_us[:-1]]))
    later = t_us > before
    add_counts(counts, {"not_available": int((~finite).sum())})
    add_counts(counts, {"out_of_order": int((finite & ~later).sum())})
    keep = finite & later
    t_us, values, jumped = t_us[keep], values[keep], jumped[keep]
    flags = np.where(jumped, ROW | GAP, ROW).astype(np.uint8)
    add_counts(counts, {JUMP: int(jumped.sum())})
    if len(t_us) > 1:
        steps = np.diff(t_us)
        gaps = steps > longest_step(steps)
        flags[1:][gaps] |= GAP
        add_counts(counts, {"gap": int(gaps.sum())})
    flags[:1] |= GAP
    return Samples(tuple(s.name for s in assembly.signals), t_us, values, flags), counts


def _refuse_falling(path: Path, t_us: NDArray[np.int64]) -> None:
    """LogError where times (n,) fall again and again: all rows but those few would be left out."""
    known = t_us[t_us > np.iinfo(np.int64).min]
    falls = int((np.diff(known) < 0).sum())
    if falls > FALLS * len(known):
        raise LogError(f"{path}: its time falls {falls} times in {len(known)} rows; sort the rows")


def _rows(columns: list[NDArray[np.float64]], are_commands: list[bool]) -> NDArray[np.int64]:
    """Indices (k,) of the rows to take of columns (n,): all, but of sensors told in turn.

    Then of the one that comes most seldom: what is on a line between two values has less noise than
    either, and next to none beside rows on the same line.
    """
    told = [
        in_turn(c) for c, is_command in zip(columns, are_commands, strict=True) if not is_command
    ]
    return min((at for at in told if len(at)), key=len, default=np.arange(len(columns[0])))


def _at_rows(
    t_us: NDArray[np.int64], column: NDArray[np.float64], at: NDArray[np.int64], of: SignalSource
) -> NDArray[np.float64]:
    """A column (n,) at rows (k,), unit of the column: what is told in turn from its neighbours.

    A sensor is on the line to its next value (`between`).  A command acts until its next one
    (`held`), or as a sample of what is faster is on the line to it, too: a row has its mean up to
    the next row.
    """
    if not of.command:
        return between(t_us, column)[at]
    if of.hold == "zero":
        return column[at] if not len(in_turn(column)) else _means(t_us, held(t_us, column), at)
    line = between(t_us, column)
    after = np.append(line[1:], line[-1:])
    return _means(t_us, np.where(np.isfinite(after), 0.5 * (line + after), line), at)


def _means(
    t_us: NDArray[np.int64], acts: NDArray[np.float64], at: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Means (k,) from row to row of what acts (n,), any unit, from each stamp to the next."""
    lasts = np.append(np.maximum(np.diff(t_us), 0), 0).astype(float)
    whole, each = (
        np.add.reduceat(part, at) for part in (lasts, np.where(lasts > 0.0, lasts * acts, 0.0))
    )
    return np.where(whole > 0.0, each / np.maximum(whole, 1.0), acts[at])


def held(t: NDArray[Any], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """A command (n,) with its blanks filled by the last one, where rows are often blank.

    A logger that writes each signal when it comes leaves the others blank.  t (n,), any unit: what
    is older than twice the usual interval between two commands is not known any more.
    """
    known = in_turn(values)
    if not len(known):
        return values
    last = np.maximum(np.searchsorted(known, np.arange(len(values)), side="right") - 1, 0)
    since = t - t[known[last]]
    usual = np.median(np.diff(t[known]))
    return np.where((since >= 0) & (since <= 2 * usual), values[known[last]], np.nan)


def between(t: NDArray[Any], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """A sensor (n,) with its blanks filled by the line to its next value, where rows often are.

    t (n,), any unit: no line spans more than twice the usual interval.
    """
    known = in_turn(values)
    if not len(known):
        return values
    after = np.clip(np.searchsorted(known, np.arange(len(values))), 1, len(known) - 1)
    spans = t[known[after]] - t[known[after - 1]]
    line = np.interp(t, t[known], values[known], np.nan, np.nan)
    is_near = spans <= 2 * np.median(np.diff(t[known]))
    return np.where(is_near | np.isfinite(values), line, np.nan)


def jumps(u: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Steps (n - 1,) of a command u (n,), any unit, that stand out from those beside them.

    None of one that trembles all the time: it has no others.
    """
    step = np.diff(u)
    if len(step) < 3:
        return np.zeros(len(step), bool)
    alone = np.zeros(len(step))
    alone[1:-1] = np.abs(step[1:-1] - 0.5 * (step[:-2] + step[2:]))
    moving = alone[1:-1][step[1:-1] != 0.0]
    usual = float(np.median(moving)) if len(moving) else 0.0
    largest = np.maximum(alone, np.maximum(np.append(alone[1:], 0.0), np.append(0.0, alone[:-1])))
    return (alone > JUMPS * usual) & (alone == largest) & (alone > 0.0)


def in_turn(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices (k,) at which a column (n,), any unit, is written in turn with others; else none."""
    known = np.flatnonzero(np.isfinite(values))
    is_often_blank = 1 < len(known) < (1.0 - IN_TURN) * len(values)
    return known if is_often_blank else known[:0]


def longest_step(steps: NDArray[np.int64]) -> float:
    """What a step (n,) may take that is no gap, us: 1.5 median steps, of even rows.

    Where more than 5 % are longer, and no multiples of the usual step as behind rows that are lost,
    no two steps are alike: 1.5 times what 95 % stay below.  So it is where more than 5 % are that
    much shorter: rows that are lost make no step shorter.
    """
    usual = float(np.median(steps))
    often = float(np.quantile(steps, OFTEN, method="lower"))  # never the longest alone
    long = steps[steps > PERIODS * usual] / max(usual, 1.0)
    is_lost = np.abs(long - np.round(long)) < ALIKE
    are_even = float(np.mean(PERIODS * steps < usual)) <= 1.0 - OFTEN
    if often <= PERIODS * usual or (are_even and np.mean(is_lost) > 0.5):
        return PERIODS * usual
    return PERIODS * often


def _role(table: Table, source: SignalSource, n: int) -> NDArray[np.float64]:
    if source.constant is not None:
        return np.full(n, source.constant)
    column = table.column(source.signal)
    if source.late_rows:
        column = _in_time(column, source.late_rows)
    if source.table is not None:
        return np.interp(column, *source.table)
    return source.factor * column + source.offset


def _in_time(column: NDArray[np.float64], late: int) -> NDArray[np.float64]:
    """A column (n,) that is written so many rows late, where it belongs: its last are not known."""
    return np.append(column[late:], np.full(min(late, len(column)), np.nan))


def named_columns(path: Path, result: Iterable[Column]) -> Table:
    """A table of titles with their columns (n,) and the units of the metadata.

    Columns whose names differ by the brackets alone keep them; of two of one title the second is
    called "title.2": none is lost.
    """
    result = list(result)
    stems = Counter(split_brackets(title)[0] for title, _, _ in result)
    columns: dict[str, NDArray[np.float64]] = {}
    units: dict[str, str] = {}
    for title, column, unit in result:
        stem, bracketed = split_brackets(title)
        name = stem if stem and stems[stem] == 1 else title.strip()
        copies = sum(known == name or known.startswith(f"{name}.") for known in columns)
        name = f"{name}.{copies + 1}" if name in columns else name
        columns[name], units[name] = column, unit or bracketed
    return Table(path, columns, units)
