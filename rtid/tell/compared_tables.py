"""The tables of a comparison, in display units."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from rtid.compare import BlockRow, Comparison, Deviation, Examination, sample_errors
from rtid.compare.dependence import DIRECTIONS
from rtid.compare.tables import CAUSES, cause_of
from rtid.study.compared import Held, TraceComparison, share_on_own_data
from rtid.tell.story import Table
from rtid.units import KPA, Scale, scale_of

WORST = 12  # blocks in the printed table; --json gives all


def _rows(studies: Sequence[TraceComparison]) -> Iterator[tuple[Held, str, Comparison, int, str]]:
    """Map, part and chamber of every line of a table."""
    for comparison in studies:
        for tested in comparison.held:
            for title, part in tested.parts.items():
                for c, chamber in enumerate(comparison.replay.model.chambers):
                    yield tested, title, part, c, chamber.name


def equation(studies: Sequence[TraceComparison]) -> Table:
    """Equation residual of every map, part and chamber."""
    pressure, flow = scale_of("Pa"), scale_of("m3/s")
    units = f"beta {pressure.name}|", f"flow {flow.name}|", f"residual {flow.name}|"
    heads = ("map", "part", "chamber", *units, "%|", "rho|", "on own data|")
    rows = []
    for tested, title, part, c, name in _rows(studies):
        learned = any(tested is comparison.held[0] for comparison in studies)
        own_share = f"{100 * share_on_own_data(part):.0f} %" if learned else ""
        figures = ("-",) * 4
        if len(part.t_s):
            whole, rest = part.flow_rms_m3s[c], part.residual_rms_m3s[c]
            share, rho = f"{100 * part.residual_share[c]:.2f}", f"{part.rho[c]:.3g}"
            figures = flow.number(whole, 2), flow.number(rest, 4), share, rho
        beta = pressure.number(tested.beta_pa[c], 1)
        rows.append((tested.name, title, name, beta, *figures, own_share))
    if not any(comparison.replay.model.has_pressures for comparison in studies):
        cells = [(*row[:3], *row[4:]) for row in rows]
        return Table("Equation residual, rms", (*heads[:3], *heads[4:]), cells, keys=3)
    return Table("Equation residual, rms", heads, rows, keys=3)


def samples(studies: Sequence[TraceComparison]) -> Table:
    """What is left of a rate that is measured itself, sample by sample; empty of other plants."""
    scale, rows = scale_of("m3/s"), []
    for comparison in studies:
        model = comparison.replay.model
        for tested in comparison.held:
            for title, part in tested.parts.items():
                for error in sample_errors(model, part):
                    sizes = (scale.number(v, 3) for v in (error.mean, error.sd, error.rms))
                    state = "a command is given" if error.given else "at rest"
                    rows.append((tested.name, title, state, f"{error.duration_s:.1f}", *sizes))
    title = f"What is left of the samples, without a filter, {scale.name}"
    heads = ("map", "part", "while", "time s|", "mean|", "standard deviation|", "rms|")
    return Table(title, heads, rows, keys=3)


def pressure(studies: Sequence[TraceComparison]) -> Table:
    """Fit and error of the simulated pressures."""
    runs = next(
        (e.simulations for f in studies for h in f.held for e in h.examinations.values()), {}
    )
    small, rows = _of_errors(), []
    for tested, part, _, c, name in _rows(studies):
        examination = tested.examinations.get(part)
        if examination is not None and examination.simulations:
            figures = [
                f"{run.fit_percent[c]:.2f} % {small.number(run.rms_pa[c], 1):>7} {small.name}"
                for run in examination.simulations.values()
            ]
            rows.append((tested.name, part, name, *figures))
    title = f"Simulated pressure: fit in % (100 is perfect) and rms error in {small.name}"
    return Table(title, ("map", "part", "chamber", *(f"{r}|" for r in runs)), rows, keys=3)


def _of_errors() -> Scale:
    """The scale of a pressure's error, which is small beside the pressure."""
    scale = scale_of("Pa")
    return scale if scale.name == "Pa" else Scale("kPa", KPA)


def checks(studies: Sequence[TraceComparison]) -> Table:
    """One line per map, part and chamber that says whether what is left is noise."""
    rows = []
    for tested, part, _, c, name in _rows(studies):
        examination = tested.examinations.get(part)
        if examination is not None and examination.cusums:
            rows.append((tested.name, part, name, *_check_cells(examination, c)))
    heads = ("map", "part", "chamber", "itself|", "inputs", "feedback", "CUSUM|", "depends most on")
    title = "What is left: lags outside the 95 % band (5 % is chance), CUSUM over its boundary"
    return Table(title, heads, rows, keys=3)


def _check_cells(examination: Examination, c: int) -> tuple[str, ...]:
    chamber = examination.cusums[c].chamber
    of_chamber = [r for r in examination.correlations if r.chamber == chamber]
    itself = ", ".join(f"{100 * r.outside:.0f} %" for r in of_chamber if r.itself)
    inputs = ", ".join(f"{r.signal} {100 * r.outside:.0f} %" for r in of_chamber if not r.itself)
    feedback = ", ".join(f"{r.signal} {100 * r.feedback:.0f} %" for r in of_chamber if not r.itself)
    best = max(examination.signals, key=lambda d: d.explained[c], default=None)
    most = f"{best.signal} {100 * best.explained[c]:.0f} %" if best else ""
    return itself, inputs, feedback, f"{examination.cusums[c].largest:.2f}", most


def directions(studies: Sequence[TraceComparison]) -> Table:
    """Residual by direction of motion."""
    flow, rows = scale_of("m3/s"), []
    for tested, part, _, c, name in _rows(studies):
        examination = tested.examinations.get(part)
        if examination is not None:
            d = examination.direction
            cells = dict.fromkeys(DIRECTIONS, "-")
            for k in range(len(d.rows)):
                mean, error, rms = (a[k, c] for a in (d.mean_m3s, d.error_m3s, d.rms_m3s))
                word = DIRECTIONS[0 if d.high[k] < 0 else 2 if d.low[k] > 0 else 1]
                cells[word] = f"{flow.known(mean, error, 4)} ({flow.number(rms, 4)})"
            rows.append((tested.name, part, name, *cells.values()))
    title = f"Residual by direction of motion: mean ±, and rms in brackets, {flow.name}"
    heads = ("map", "part", "chamber", *(f"{word}|" for word in DIRECTIONS))
    return Table(title, heads, rows, keys=3)


def causes(comparison: TraceComparison) -> Table:
    """How many blocks of each edge are identified, and what the others lack."""
    rows = []
    for edge in comparison.replay.model.maps:
        count = Counter(cause_of(row) for row in comparison.blocks if row.edge == edge.name)
        visited = sum(count.values())
        count[CAUSES[-1]] += edge.grid.shape[0] * edge.grid.shape[1] - visited
        rows.append((edge.name, *(str(count[cause]) for cause in CAUSES)))
    title = "Blocks of the map, and why the others are not identified"
    return Table(title, ("edge", *(f"{cause}|" for cause in CAUSES)), rows)


def blocks(comparison: TraceComparison, title: str) -> Table:
    """The blocks that hold most of the residual of one part, and why they are not identified."""
    flow = scale_of("m3/s")
    units = f"dp {scale_of('Pa').name}|", "rows|", f"flow ± {flow.name}|", f"residual {flow.name}|"
    heads = ("edge", "block", "u V|", *units, "share|", "why not identified~")
    name = f", {comparison.held[0].name}" if comparison.held[0].name != "learned" else ""
    text = f"The {WORST} blocks with the largest share of the residual ({title}{name})"
    known = [row for row in comparison.blocks_of[title] if row.residual_rms_m3s >= 0]
    model = comparison.replay.model
    if not model.has_pressures:  # the second argument is one of any unit, or none
        heads = ("map", "block", "u|", "over|", *units[1:], *heads[-2:])
    rows = [
        (
            row.edge,
            f"{row.i},{row.j}",
            *ranges(row, scale_of("Pa").factor if model.has_pressures else 1.0),
            str(row.rows),
            flow.known(row.flow_m3s, row.sd_m3s, 3) if np.isfinite(row.flow_m3s) else "-",
            flow.number(row.residual_rms_m3s, 3) if np.isfinite(row.residual_rms_m3s) else "-",
            f"{100 * row.residual_share:.1f} %",
            row.reason or row.status,
        )
        for row in sorted(known, key=lambda row: -row.residual_share)[:WORST]
    ]
    return Table(text, heads, rows, keys=2)


def ranges(row: BlockRow, factor: float) -> tuple[str, str]:
    """The block's borders in V, and of the drop times a factor."""
    u, dp = row.u_v, row.dp_pa
    return f"{u[0]:g}..{u[1]:g}", f"{dp[0] * factor:g}..{dp[1] * factor:g}"


def differences(deviations: list[Deviation], item: str, other: str) -> Table:
    """Two maps beside each other, per edge."""
    pressure, flow = scale_of("Pa"), scale_of("m3/s")
    rows: list[tuple[str, ...]] = []
    for d in deviations:
        if not d.valid.any():
            rows.append((d.edge, "0", *("",) * 6))
            continue
        share = abs(d.share_of_largest[d.valid]) * 100
        worst = share.argmax()
        at = [a[d.valid][worst] for a in (d.w_v, d.dp_pa, d.flow_m3s, d.reference_m3s)]
        factors = (1.0, pressure.factor, flow.factor, flow.factor)
        scaled = (f"{v * f:.4g}" for v, f in zip(at, factors, strict=True))
        count = str(int(d.valid.sum()))
        rows.append((d.edge, count, f"{share.mean():.2f}", f"{share.max():.2f}", *scaled))
    names = [f"{name} {flow.name}|" for name in (item, other)]
    heads = ("edge", "valid blocks|", "mean %|", "largest %|", "at u V|", f"dp {pressure.name}|")
    title = f"{item} minus {other}, % of the largest flow, valid blocks"
    return Table(title[0].upper() + title[1:], (*heads, *names), rows)
