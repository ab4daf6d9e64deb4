"""A comparison in words and tables: first what it means, then the figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rtid.compare import FREE_RUN
from rtid.compare.simulation import REASONS
from rtid.study.compared import Held, TraceComparison, blocks_in_span, changes, spans_of_block
from rtid.tell import compared_tables as tables
from rtid.tell.story import Story, Table
from rtid.units import CONVENTION, scale_of

WORTH_SAYING = 0.1  # of the residual's variance
CHANCE = 0.15  # of the lags outside: 0.05 is chance, and neighbouring lags are alike
MOST_SPANS = 40


def story(studies: Sequence[TraceComparison]) -> Story:
    """Everything of one study, or of two side by side."""
    shown = [
        tables.equation(studies),
        tables.samples(studies),
        tables.pressure(studies),
        tables.checks(studies),
        tables.directions(studies),
    ]
    for result in studies:
        shown.append(tables.causes(result))
        shown += [tables.blocks(result, title) for title in result.blocks_of]
        for name, rows in result.deviations_of.items():
            shown.append(tables.differences(rows, result.held[0].name, name))
    if len(studies) > 1:
        names = [result.held[0].name for result in studies]
        shown.append(tables.differences(changes(*studies[:2]), *names[:2]))
    return Story("", (*sentences(studies), *shown, CONVENTION))


def of_block(comparison: TraceComparison, edge: str, i: int, j: int) -> Story:
    """When the working point was in a block, and why it is or is not identified."""
    spans = spans_of_block(comparison, edge, i, j)
    total = sum(t1 - t0 for t0, t1 in spans)
    row = next((r for r in comparison.blocks if (r.edge, r.i, r.j) == (edge, i, j)), None)
    state = f"{row.status}. {row.reason}" if row and row.reason else row.status if row else "empty"
    visits = f"Block {edge}:{i},{j} was visited {len(spans)} times, {total:.2f} s: {state}"
    shown = ", ".join(f"{t0:.3f}..{t1:.3f}" for t0, t1 in spans[:MOST_SPANS])
    rest = len(spans) - MOST_SPANS
    more = f" and {rest} more (--json lists all)" if rest > 0 else ""
    return Story(visits, (f"  s: {shown}{more}",) if spans else ())


def of_span(comparison: TraceComparison, t0_s: float, t1_s: float) -> Story:
    """The blocks that were visited in a span of time."""
    title = f"Blocks visited between {t0_s:g} and {t1_s:g} s"
    heads = ("edge", "block", "u V|", f"dp {scale_of('Pa').name}|", "time s|", "status~")
    cells = []
    rows = {(r.edge, r.i, r.j): r for rows in comparison.blocks_of.values() for r in rows}
    for visit in blocks_in_span(comparison, t0_s, t1_s):
        row = rows.get((visit.edge, visit.i, visit.j))
        ranges = tables.ranges(row, scale_of("Pa").factor) if row else ("", "")
        state = (row.reason or row.status) if row else ""
        place = f"{visit.i},{visit.j}"
        cells.append((visit.edge, place, *ranges, f"{visit.time_s:.3f}", state))
    return Story("", (Table(title, heads, cells, keys=2) if cells else f"{title}: none",))


def sentences(studies: Sequence[TraceComparison]) -> Iterator[str]:
    """What the figures mean, on the part that the fit has not seen where there is one."""
    for comparison in studies:
        names = [chamber.name for chamber in comparison.replay.model.chambers]
        for tested in comparison.held:
            yield from _of_map(tested, names)
        yield from _of_checks(comparison.held[0])
    if len(studies) > 1:
        yield from _verdict([comparison.held[0] for comparison in studies])


def _of_map(tested: Held, names: list[str]) -> Iterator[str]:
    title, part = list(tested.parts.items())[-1]
    if not len(part.t_s):
        yield f"The {title} part holds no row: nothing to compare."
        return
    text = _each(names, part.residual_share, lambda share: f"{100 * share:.2g} %")
    line = f"With the {tested.name} map, {text} of the flow stay unexplained ({title})"
    examination = tested.examinations.get(title)
    if examination is not None and examination.simulations:
        run = examination.simulations[FREE_RUN]
        line += f"; run freely, its pressures fit to {_each(names, run.fit_percent, _percent)}"
        bad = ", ".join(f"{n} x {REASONS[reason]}" for reason, n in run.stops.items() if n)
        line += f", begun anew after: {bad}" if bad else ""
        if run.beyond_share > 0:
            line += (
                f", {100 * run.beyond_share:.1f} % of the time beyond the grid along its tangent"
            )
    elif examination is not None:
        line += f"; no free run: {examination.no_free_run}"
    yield line + "."


def _of_checks(tested: Held) -> Iterator[str]:
    """Change over time, colour and dependence of what the learned map leaves."""
    for title, examination in tested.examinations.items():
        crossed = [c for c in examination.cusums if c.crosses_s is not None]
        for c in crossed:
            yield (
                f"Chamber {c.chamber} ({title}): the model begins to fail at about "
                f"{c.change_s:.1f} s; the sum of its recursive residuals leaves the 5 % boundary "
                f"at {c.crosses_s:.1f} s."
            )
        if not crossed and examination.cusums:
            yield (
                f"Nothing changes during the {title} part: no sum of recursive residuals leaves "
                "its 5 % boundary."
            )
    yield from _of_dependence(tested)


def _of_dependence(tested: Held) -> Iterator[str]:
    title, examination = next(iter(tested.examinations.items()), ("", None))
    if examination is None:
        return
    for c in examination.correlations:
        if c.outside > CHANCE:
            what = "with themselves" if c.itself else f"with {c.signal} before them"
            yield (
                f"The innovations of chamber {c.chamber} ({title}) are correlated {what}: "
                f"{100 * c.outside:.0f} % of the lags lie outside the 95 % band."
            )
    chambers = examination.equation.residual_m3s.shape[1]
    for k in range(chambers):
        best = max(examination.signals, key=lambda d: d.explained[k], default=None)
        if best is not None and best.explained[k] > WORTH_SAYING:
            yield (
                f"What is left in chamber {examination.cusums[k].chamber} ({title}) depends most "
                f"on "
                f"{best.signal}: it explains {100 * best.explained[k]:.0f} % of the variance."
            )


def _verdict(tested: Sequence[Held]) -> Iterator[str]:
    """Which of two leaves less, on the last part that both have."""
    first, two = tested[:2]
    titles = [title for title in first.parts if title in two.parts]
    if not titles:
        return
    a, b = (float(np.mean(h.parts[titles[-1]].residual_share)) for h in (first, two))
    better, worse = (first, two) if a <= b else (two, first)
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
