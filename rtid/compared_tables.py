"""The tables of a comparison, in display units."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from rich.table import Table

from rtid.compare import BlockRow, Comparison, Deviation, Examination
from rtid.compare.dependence import DIRECTIONS
from rtid.compare.tables import CAUSES, cause_of
from rtid.comparing import Held, TraceComparison, share_on_own_data
from rtid.units import KPA, LPM, MPA

Z95 = 1.96
WORST = 12  # blocks in the printed table; --json gives all


def _rows(
    studies: Sequence[TraceComparison],
) -> Iterator[tuple[Held, str, Comparison, int, str]]:
    """Map, part and chamber of every line of a table."""
    for found in studies:
        for held in found.held:
            for title, part in held.parts.items():
                for c, chamber in enumerate(found.replay.model.chambers):
                    yield held, title, part, c, chamber.name


def equation(studies: Sequence[TraceComparison]) -> Table:
    """Equation residual of every map, part and chamber."""
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


def pressure(studies: Sequence[TraceComparison]) -> Table:
    """Fit and error of the simulated pressures."""
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


def checks(studies: Sequence[TraceComparison]) -> Table:
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


def directions(studies: Sequence[TraceComparison]) -> Table:
    """Residual by direction of motion."""
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


def causes(found: TraceComparison) -> Table:
    """How many blocks of each edge are identified, and what the others lack."""
    title = "Blocks of the map, and why the others are not identified"
    table = Table("edge", *CAUSES, title=title, title_justify="left", box=None)
    for edge in found.replay.model.edges:
        count = Counter(cause_of(row) for row in found.blocks if row.edge == edge.name)
        visited = sum(count.values())
        count[CAUSES[-1]] += edge.grid.shape[0] * edge.grid.shape[1] - visited
        table.add_row(edge.name, *(str(count[cause]) for cause in CAUSES))
    return table


def blocks(found: TraceComparison, title: str) -> Table:
    """The blocks that hold most of the residual of one part, and why they are not identified."""
    heads = ("edge", "block", "u V", "dp MPa", "rows", "flow L/min", "sd", "residual", "share")
    name = f", {found.held[0].name}" if found.held[0].name != "learned" else ""
    text = f"The {WORST} blocks with the largest share of the residual ({title}{name})"
    table = Table(*heads, "why not identified", title=text, title_justify="left", box=None)
    known = [row for row in found.blocks_of[title] if row.residual_rms_m3s >= 0]
    for row in sorted(known, key=lambda row: -row.residual_share)[:WORST]:
        table.add_row(
            row.edge,
            f"{row.i},{row.j}",
            *ranges(row),
            str(row.rows),
            _number(row.flow_m3s),
            _number(row.sd_m3s),
            _number(row.residual_rms_m3s),
            f"{100 * row.residual_share:.1f} %",
            row.reason or row.status,
        )
    return table


def ranges(row: BlockRow) -> tuple[str, str]:
    """The block's borders in V and MPa."""
    u, dp = row.u_v, row.dp_pa
    return f"{u[0]:g}..{u[1]:g}", f"{dp[0] * MPA:g}..{dp[1] * MPA:g}"


def _number(flow_m3s: float) -> str:
    return f"{flow_m3s * LPM:.3f}" if np.isfinite(flow_m3s) else "-"


def differences(found: list[Deviation], one: str, other: str) -> Table:
    """Two maps beside each other, per edge."""
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
