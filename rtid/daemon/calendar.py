"""What the history says of two spans of the calendar: this week beside the last one.

A mean of n estimates has the scatter of their values as its deviation: they are published from one
growing estimate and are not independent, so that it is not divided by sqrt(n).

An estimate counts where it is known: a bulk modulus by three deviations of itself, since it is
never zero.  Other quantities may come back to zero (a leak that was mended, a sensor's offset) and
are known there too: theirs count by a deviation within a third of the largest value that was surely
seen in the span.  All that counts weighs the same: weights by the deviation would show only how the
span ended.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from rtid.daemon.chronicle import DAY_S, FILE
from rtid.errors import RtidError
from rtid.tell.story import Table
from rtid.units import scale_of

NOTES = "CREATE TABLE IF NOT EXISTS note (from_s REAL, until_s REAL, who TEXT, text TEXT)"
KNOWN = "1e100"  # what is not known yet is infinite
SURE = "0.333"  # of a value, its deviation at most: that of an estimate without data is beyond it
END_S = 1e100  # of a span that is open
MOST_POINTS = 400  # of a trend
# what counts of two tables between two times
MODULI = f"""FROM estimate WHERE unix_s >= ? AND unix_s < ?
  AND beta_sd_pa <= {SURE} * beta_pa AND beta_pa < {KNOWN}"""
QUANTITIES = f"""FROM (
  SELECT *, max(CASE WHEN sd <= {SURE} * abs(value) THEN abs(value) END)
    OVER (PARTITION BY name, unit) AS seen
  FROM quantity WHERE unix_s >= ? AND unix_s < ? AND abs(value) < {KNOWN}
) WHERE sd <= {SURE} * seen"""


@dataclass(frozen=True)
class Span:
    """Seconds since 1970."""

    from_s: float
    until_s: float


@dataclass(frozen=True)
class Row:
    """One quantity in the span before and in this one: mean and scatter, None where there is none.

    unit: SI, "" for a count or a share.
    """

    name: str
    unit: str
    before: tuple[float, float] | None
    now: tuple[float, float] | None


@dataclass(frozen=True)
class SpanNote:
    """What somebody has written about a span."""

    from_s: float
    until_s: float
    who: str
    text: str


TrendPoint = tuple[float, float, float]


@dataclass(frozen=True)
class TrendLine:
    """A quantity over time: unix_s, value and standard deviation, SI, the oldest first."""

    name: str
    unit: str
    points: tuple[TrendPoint, ...]


@contextmanager
def _opened(folder: Path, may_write: bool = False) -> Iterator[sqlite3.Connection]:
    path = folder / FILE
    if not path.is_file():
        raise RtidError(f"{path}: there is no history", "`rtid run` writes it while it learns")
    mode = "rw" if may_write else "ro"
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode={mode}", uri=True)) as base:
            yield base
            base.commit()
    except sqlite3.Error as error:
        raise RtidError(f"{path}: {error}", "is it the history of a daemon?") from None


def two_spans(days: float, until_s: float | None = None) -> tuple[Span, Span]:
    """The last days, and as many before them: (before, now)."""
    end = time.time() if until_s is None else until_s
    length = days * DAY_S
    return Span(end - 2 * length, end - length), Span(end - length, end)


def side_by_side(folder: Path, before: Span, now: Span) -> list[Row]:
    """Every quantity of the history in two spans.  Raises RtidError where there is none."""
    with _opened(folder) as base:
        both = [_values(base, span) for span in (before, now)]
    names = sorted({*both[0], *both[1]})
    return [Row(*name, both[0].get(name), both[1].get(name)) for name in names]


def _values(base: sqlite3.Connection, span: Span) -> dict[tuple[str, str], tuple[float, float]]:
    """Mean and scatter by name and unit."""
    ends = (span.from_s, span.until_s)
    mean = "avg({0}), sqrt(max(0, avg({0} * {0}) - avg({0}) * avg({0})))"
    found: dict[tuple[str, str], tuple[float, float]] = {}
    for chamber, v, sd in base.execute(
        f"SELECT chamber, {mean.format('beta_pa')} {MODULI} GROUP BY chamber", ends
    ):
        found[f"bulk modulus {chamber}", "Pa"] = (v, sd)
    for edge, v, sd in base.execute(
        f"SELECT edge, {mean.format('valid * 1.0')} FROM map WHERE unix_s >= ? AND unix_s < ? "
        "GROUP BY edge", ends,
    ):  # fmt: skip
        found[f"blocks known, valve {edge}", ""] = (v, sd)
    if _has(base, "quantity"):
        rows = base.execute(
            f"SELECT name, unit, {mean.format('value')} {QUANTITIES} GROUP BY name, unit", ends
        )
        found |= {(name, unit): (v, sd) for name, unit, v, sd in rows}
    for v, sd in base.execute(
        f"SELECT {mean.format('rho')} FROM map WHERE unix_s >= ? AND unix_s < ?", ends
    ):
        if v is not None and sd is not None:
            found["residual variance, of the noise", ""] = (v, sd)
    for name, n in base.execute(
        "SELECT name, count(*) FROM alarm WHERE over = 0 AND unix_s >= ? AND unix_s < ? "
        "GROUP BY name", ends,
    ):  # fmt: skip
        found[f"alarm {name}", "times"] = (float(n), 0.0)
    return found


def trend(folder: Path, since_s: float) -> list[TrendLine]:
    """What was learned since a time, thinned to means: bulk moduli, then lag and sizes by name."""
    with _opened(folder) as base:
        found = list(_thinned(base, MODULI, "chamber", "beta_pa", "beta_sd_pa", since_s))
        trends = [TrendLine(f"bulk modulus {name}", "Pa", points) for (name,), points in found]
        if _has(base, "quantity"):
            found = list(_thinned(base, QUANTITIES, "name, unit", "value", "sd", since_s))
            trends += [TrendLine(name, unit, points) for (name, unit), points in found]
    return trends


def _thinned(
    base: sqlite3.Connection, known: str, key: str, value: str, sd: str, since_s: float
) -> Iterator[tuple[tuple[str, ...], tuple[TrendPoint, ...]]]:
    """Means over the MOST_POINTS part of the time that there is something of, by key."""
    span = (since_s, END_S)
    first, last = base.execute(f"SELECT min(unix_s), max(unix_s) {known}", span).fetchone()
    if first is None:
        return
    step_s = max((last - first) / (MOST_POINTS - 1), 1e-3)
    rows = base.execute(
        f"SELECT {key}, avg(unix_s), avg({value}), avg({sd}) {known} "
        f"GROUP BY {key}, CAST((unix_s - ?) / ? AS INTEGER) ORDER BY {key}, avg(unix_s)",
        (*span, first, step_s),
    ).fetchall()
    for name, group in groupby(rows, lambda row: tuple(row[:-3])):
        yield name, tuple((t, v, deviation) for *_, t, v, deviation in group)


def _has(base: sqlite3.Connection, table: str) -> bool:
    """A history that an older daemon has written has less."""
    asked = "SELECT 1 FROM sqlite_master WHERE name = ?"
    return base.execute(asked, (table,)).fetchone() is not None


def notes(folder: Path, span: Span) -> list[SpanNote]:
    """What was written about spans that touch this one, oldest first."""
    with _opened(folder) as base:
        if not _has(base, "note"):
            return []
        rows = base.execute(
            "SELECT from_s, until_s, who, text FROM note WHERE until_s >= ? AND from_s < ? "
            "ORDER BY from_s", (span.from_s, span.until_s),
        )  # fmt: skip
        return [SpanNote(*row) for row in rows]


def write_note(folder: Path, note: SpanNote) -> None:
    """Keep what somebody says of a span.  Raises RtidError where there is no history."""
    with _opened(folder, may_write=True) as base:
        base.execute(NOTES)
        row = (note.from_s, note.until_s, note.who, note.text)
        base.execute("INSERT INTO note VALUES (?, ?, ?, ?)", row)


def calendar_table(days: float, rows: Sequence[Row]) -> Table:
    """One line per quantity; ± is the scatter of its estimates within the span."""
    title = f"the last {days:g} days beside as many before; ± is the scatter within a span"
    heads = ("", "before|", "now|", "change|", "")
    return Table(title, heads, [_calendar_row(row) for row in rows])


def _calendar_row(row: Row) -> tuple[str, ...]:
    scale = scale_of(row.unit)
    words = [
        "-" if pair is None else f"{scale.factor * pair[0]:.4g} ± {scale.factor * pair[1]:.2g}"
        for pair in (row.before, row.now)
    ]
    if row.before is None or row.now is None:
        return f"{row.name} {scale.name}".rstrip(), *words, "", ""
    change, spread = row.now[0] - row.before[0], row.before[1] + row.now[1]
    remark = "more than both scatter" if abs(change) > spread and change else ""
    return f"{row.name} {scale.name}".rstrip(), *words, f"{scale.factor * change:+.3g}", remark
