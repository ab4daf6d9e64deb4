"""A comparison in words and tables: first what it means, then the figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rtid.compare import FREE_RUN, BlockRow, Comparison, Deviation, Examination
from rtid.compare.dependence import DIRECTIONS
from rtid.compare.simulation import REASONS
from rtid.compare.tables import CAUSES, cause_of
from rtid.comparing import (
    Held,
    TraceComparison,
    blocks_in_span,
    changes,
    share_on_own_data,
    spans_of_block,
)

LPM, MPA, KPA = 6e4, 1e-6, 1e-3
Z95 = 1.96
WORST = 12  # blocks in the printed table; --json gives all
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
    tables = [_equation(studies), _pressure(studies), _checks(studies), _directions(studies)]
    for found in studies:
        tables.append(_causes(found))
        tables += [_blocks(found, title) for title in found.blocks_of]
        for name, rows in found.deviations_of.items():
            tables.append(_differences(rows, found.held[0].name, name))
    if len(studies) > 1:
        names = [found.held[0].name for found in studies]
        tables.append(_differences(changes(*studies[:2]), *names[:2]))
    for table in tables:
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
        ranges = _ranges(row) if row else ("", "")
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


def _rows(
    studies: Sequence[TraceComparison],
) -> Iterator[tuple[Held, str, Comparison, int, str]]:
    """Map, part and chamber of every line of a table."""
    for found in studies:
        for held in found.held:
            for title, part in held.parts.items():
                for c, chamber in enumerate(found.replay.model.chambers):
                    yield held, title, part, c, chamber.name


def _equation(studies: Sequence[TraceComparison]) -> Table:
    heads = ("map", "part", "chamber", "beta MPa", "flow L/min", "residual L/min", "%", "rho")
    table = Table(
        *heads, "on own data", title="Equation residual, rms", title_justify="left", box=None
    )
    for held, title, part, c, name in _rows(studies):
        beta = f"{held.beta_pa[c] * MPA:.1f}"
        learned = any(held is found.held[0] for found in studies)
        own = f"{100 * share_on_own_data(part):.0f} %" if learned else ""
        figures = ("-",) * 4
        if len(part.t_s):
            flow, residual = part.flow_rms_m3s[c] * LPM, part.residual_rms_m3s[c] * LPM
            share, rho = 100 * part.residual_share[c], part.rho[c]
            figures = f"{flow:.2f}", f"{residual:.4f}", f"{share:.2f}", f"{rho:.3g}"
        table.add_row(held.name, title, name, beta, *figures, own)
    return table


def _pressure(studies: Sequence[TraceComparison]) -> Table:
    runs = next(
        (e.simulations for f in studies for h in f.held for e in h.examinations.values()), {}
    )
    title = "Simulated pressure: fit in % (100 is perfect) and rms error in kPa"
    table = Table("map", "part", "chamber", *runs, title=title, title_justify="left", box=None)
    for held, part, _, c, name in _rows(studies):
        found = held.examinations.get(part)
        if found is not None and found.simulations:
            figures = [
                f"{run.fit_percent[c]:.2f} % {run.rms_pa[c] * KPA:7.1f} kPa"
                for run in found.simulations.values()
            ]
            table.add_row(held.name, part, name, *figures)
    return table


def _checks(studies: Sequence[TraceComparison]) -> Table:
    """One line per map, part and chamber that says whether what is left is noise."""
    heads = ("map", "part", "chamber", "itself", "inputs", "feedback", "CUSUM", "depends most on")
    title = "What is left: lags outside the 95 % band (5 % is chance), CUSUM over its boundary"
    table = Table(*heads, title=title, title_justify="left", box=None)
    for held, part, _, c, name in _rows(studies):
        found = held.examinations.get(part)
        if found is not None and found.cusums:
            table.add_row(held.name, part, name, *_check_cells(found, c))
    return table


def _check_cells(found: Examination, c: int) -> tuple[str, ...]:
    chamber = found.cusums[c].chamber
    own = [r for r in found.correlations if r.chamber == chamber]
    itself = ", ".join(f"{100 * r.outside:.0f} %" for r in own if r.itself)
    inputs = ", ".join(f"{r.signal} {100 * r.outside:.0f} %" for r in own if not r.itself)
    feedback = ", ".join(f"{r.signal} {100 * r.feedback:.0f} %" for r in own if not r.itself)
    best = max(found.signals, key=lambda d: d.explained[c], default=None)
    most = f"{best.signal} {100 * best.explained[c]:.0f} %" if best else ""
    return itself, inputs, feedback, f"{found.cusums[c].largest:.2f}", most


def _directions(studies: Sequence[TraceComparison]) -> Table:
    title = "Residual by direction of motion: mean +- 95 %, and rms in brackets, L/min"
    heads = ("map", "part", "chamber", *DIRECTIONS)
    table = Table(*heads, title=title, title_justify="left", box=None)
    for held, part, _, c, name in _rows(studies):
        found = held.examinations.get(part)
        if found is not None:
            d = found.direction
            cells = dict.fromkeys(DIRECTIONS, "-")
            for k in range(len(d.rows)):
                mean, error, rms = (a[k, c] * LPM for a in (d.mean_m3s, d.error_m3s, d.rms_m3s))
                word = DIRECTIONS[0 if d.high[k] < 0 else 2 if d.low[k] > 0 else 1]
                cells[word] = f"{mean:+.4f} +- {Z95 * error:.4f} ({rms:.4f})"
            table.add_row(held.name, part, name, *cells.values())
    return table


def _causes(found: TraceComparison) -> Table:
    """How many blocks of each edge are identified, and what the others lack."""
    title = "Blocks of the map, and why the others are not identified"
    table = Table("edge", *CAUSES, title=title, title_justify="left", box=None)
    for edge in found.replay.model.edges:
        count = Counter(cause_of(row) for row in found.blocks if row.edge == edge.name)
        visited = sum(count.values())
        count[CAUSES[-1]] += edge.grid.shape[0] * edge.grid.shape[1] - visited
        table.add_row(edge.name, *(str(count[cause]) for cause in CAUSES))
    return table


def _blocks(found: TraceComparison, title: str) -> Table:
    heads = ("edge", "block", "u V", "dp MPa", "rows", "flow L/min", "sd", "residual", "share")
    name = f", {found.held[0].name}" if found.held[0].name != "learned" else ""
    text = f"The {WORST} blocks with the largest share of the residual ({title}{name})"
    table = Table(*heads, "why not identified", title=text, title_justify="left", box=None)
    known = [row for row in found.blocks_of[title] if row.residual_rms_m3s >= 0]
    for row in sorted(known, key=lambda row: -row.residual_share)[:WORST]:
        table.add_row(
            row.edge,
            f"{row.i},{row.j}",
            *_ranges(row),
            str(row.rows),
            _number(row.flow_m3s),
            _number(row.sd_m3s),
            _number(row.residual_rms_m3s),
            f"{100 * row.residual_share:.1f} %",
            row.reason or row.status,
        )
    return table


def _ranges(row: BlockRow) -> tuple[str, str]:
    u, dp = row.u_v, row.dp_pa
    return f"{u[0]:g}..{u[1]:g}", f"{dp[0] * MPA:g}..{dp[1] * MPA:g}"


def _number(flow_m3s: float) -> str:
    return f"{flow_m3s * LPM:.3f}" if np.isfinite(flow_m3s) else "-"


def _differences(found: list[Deviation], one: str, other: str) -> Table:
    heads = ("edge", "valid blocks", "mean %", "largest %", "at u V", "dp MPa", one, other)
    title = f"{one} minus {other}, % of the largest flow, valid blocks"
    title = title[0].upper() + title[1:]
    table = Table(*heads, title=title, title_justify="left", box=None)
    for d in found:
        if not d.valid.any():
            table.add_row(d.edge, "0")
            continue
        share = abs(d.share_of_largest[d.valid]) * 100
        worst = share.argmax()
        at = [a[d.valid][worst] for a in (d.w_v, d.dp_pa, d.flow_m3s, d.reference_m3s)]
        scaled = (f"{v * f:.4g}" for v, f in zip(at, (1, MPA, LPM, LPM), strict=True))
        count = str(int(d.valid.sum()))
        table.add_row(d.edge, count, f"{share.mean():.2f}", f"{share.max():.2f}", *scaled)
    return table
