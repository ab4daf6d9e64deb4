"""A comparison in words and tables: first what it means, then the figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rtid import compared_tables as tables
from rtid.compare import FREE_RUN
from rtid.compare.simulation import REASONS
from rtid.comparing import (
    Held,
    TraceComparison,
    blocks_in_span,
    changes,
    spans_of_block,
)

WIDTH = 118  # where the output is no terminal
WORTH_SAYING = 0.1  # of the residual's variance
CHANCE = 0.15  # of the lags outside: 0.05 is chance, and neighbouring lags are alike
MOST_SPANS = 40


def make_console() -> Console:
    """A console that is wide enough for the tables where the output is no terminal."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=WIDTH)


def tell(console: Console, studies: Sequence[TraceComparison]) -> None:
    """The whole story of one study, or of two side by side."""
    for line in sentences(studies):
        console.print(line)
    console.print()
    found_tables = [
        tables.equation(studies),
        tables.pressure(studies),
        tables.checks(studies),
        tables.directions(studies),
    ]
    for found in studies:
        found_tables.append(tables.causes(found))
        found_tables += [tables.blocks(found, title) for title in found.blocks_of]
        for name, rows in found.deviations_of.items():
            found_tables.append(tables.differences(rows, found.held[0].name, name))
    if len(studies) > 1:
        names = [found.held[0].name for found in studies]
        found_tables.append(tables.differences(changes(*studies[:2]), *names[:2]))
    for table in found_tables:
        if table.row_count:
            console.print(table)
            console.print()


def tell_block(console: Console, found: TraceComparison, edge: str, i: int, j: int) -> None:
    """When the working point was in a block, and why it is or is not identified."""
    spans = spans_of_block(found, edge, i, j)
    total = sum(t1 - t0 for t0, t1 in spans)
    row = next((r for r in found.blocks if (r.edge, r.i, r.j) == (edge, i, j)), None)
    state = f"{row.status}. {row.reason}" if row and row.reason else row.status if row else "empty"
    console.print(f"Block {edge}:{i},{j} was visited {len(spans)} times, {total:.2f} s: {state}")
    shown = ", ".join(f"{t0:.3f}..{t1:.3f}" for t0, t1 in spans[:MOST_SPANS])
    rest = len(spans) - MOST_SPANS
    more = f" and {rest} more (--json lists all)" if rest > 0 else ""
    console.print(f"  s: {shown}{more}\n" if spans else "")


def tell_span(console: Console, found: TraceComparison, t0_s: float, t1_s: float) -> None:
    """The blocks that were visited in a span of time."""
    table = Table(
        *("edge", "block", "u V", "dp MPa", "time s", "status"),
        title=f"Blocks visited between {t0_s:g} and {t1_s:g} s",
        title_justify="left",
        box=None,
    )
    rows = {(r.edge, r.i, r.j): r for rows in found.blocks_of.values() for r in rows}
    for visit in blocks_in_span(found, t0_s, t1_s):
        row = rows.get((visit.edge, visit.i, visit.j))
        ranges = tables.ranges(row) if row else ("", "")
        state = (row.reason or row.status) if row else ""
        place = f"{visit.i},{visit.j}"
        table.add_row(visit.edge, place, *ranges, f"{visit.time_s:.3f}", state)
    console.print(table)
    console.print()


def sentences(studies: Sequence[TraceComparison]) -> Iterator[str]:
    """What the figures mean, on the part that the fit has not seen where there is one."""
    for found in studies:
        names = [chamber.name for chamber in found.replay.model.chambers]
        for held in found.held:
            yield from _of_map(held, names)
        yield from _of_checks(found.held[0])
    if len(studies) > 1:
        yield from _verdict([found.held[0] for found in studies])


def _of_map(held: Held, names: list[str]) -> Iterator[str]:
    title, part = list(held.parts.items())[-1]
    if not len(part.t_s):
        yield f"The {title} part holds no row: nothing to compare."
        return
    text = _each(names, part.residual_share, lambda share: f"{100 * share:.2g} %")
    line = f"With the {held.name} map, {text} of the flow stay unexplained ({title})"
    found = held.examinations.get(title)
    if found is not None and found.simulations:
        run = found.simulations[FREE_RUN]
        line += f"; run freely, its pressures fit to {_each(names, run.fit_percent, _percent)}"
        bad = ", ".join(f"{n} x {REASONS[reason]}" for reason, n in run.stops.items() if n)
        line += f", begun anew after: {bad}" if bad else ""
        if run.beyond_share > 0:
            line += (
                f", {100 * run.beyond_share:.1f} % of the time beyond the grid along its tangent"
            )
    elif found is not None:
        line += f"; no free run: {found.no_free_run}"
    yield line + "."


def _of_checks(held: Held) -> Iterator[str]:
    """Change over time, colour and dependence of what the learned map leaves."""
    for title, found in held.examinations.items():
        crossed = [c for c in found.cusums if c.crosses_s is not None]
        for c in crossed:
            yield (
                f"Chamber {c.chamber} ({title}): the model begins to fail at about "
                f"{c.change_s:.1f} s; the sum of its recursive residuals leaves the 5 % boundary "
                f"at {c.crosses_s:.1f} s."
            )
        if not crossed and found.cusums:
            yield (
                f"Nothing changes during the {title} part: no sum of recursive residuals leaves "
                "its 5 % boundary."
            )
    yield from _of_dependence(held)


def _of_dependence(held: Held) -> Iterator[str]:
    title, found = next(iter(held.examinations.items()), ("", None))
    if found is None:
        return
    for c in found.correlations:
        if c.outside > CHANCE:
            what = "with themselves" if c.itself else f"with {c.signal} before them"
            yield (
                f"The innovations of chamber {c.chamber} ({title}) are correlated {what}: "
                f"{100 * c.outside:.0f} % of the lags lie outside the 95 % band."
            )
    chambers = found.equation.residual_m3s.shape[1]
    for k in range(chambers):
        best = max(found.signals, key=lambda d: d.explained[k], default=None)
        if best is not None and best.explained[k] > WORTH_SAYING:
            yield (
                f"What is left in chamber {found.cusums[k].chamber} ({title}) depends most on "
                f"{best.signal}: it explains {100 * best.explained[k]:.0f} % of the variance."
            )


def _verdict(held: Sequence[Held]) -> Iterator[str]:
    """Which of two leaves less, on the last part that both have."""
    one, two = held[:2]
    titles = [title for title in one.parts if title in two.parts]
    if not titles:
        return
    a, b = (float(np.mean(h.parts[titles[-1]].residual_share)) for h in (one, two))
    better, worse = (one, two) if a <= b else (two, one)
    less, more = sorted((a, b))
    yield (
        f"{better.name} explains the {titles[-1]} part better than {worse.name}: "
        f"{100 * less:.2g} % against {100 * more:.2g} % of the flow."
    )


def _each(names: list[str], values: Any, text: Any) -> str:
    words = [f"{text(v)} in chamber {n}" for n, v in zip(names, values, strict=True)]
    return " and ".join(words)


def _percent(value: float) -> str:
    return f"{value:.1f} %"
