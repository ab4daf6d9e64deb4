"""Judge a project against a trace: arrays in, `Report` out, ending in sentences with remedies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from firmware_bridge.config import Assembly
from firmware_bridge.samples import Samples
from firmware_bridge.sources.table import APART
from rtid.estimator.coloured import Coloured
from rtid.model import SENSORS, Machine, Signal
from rtid.project import Project
from rtid.trace.arrivals import GAP_PERIODS, Timing, timing
from rtid.trace.before_filter import noises_before
from rtid.trace.between import FASTEST_S, unknown_between
from rtid.trace.coverage import Coverage, coverage
from rtid.trace.plausible import Motion, looks_like, motion
from rtid.trace.repeated import rows_per_value
from rtid.trace.series import Series, SignalReport, describe
from rtid.trace.signals import Recording
from rtid.trace.spikes import SPIKE
from rtid.units import limit, units_of, with_unit

LATE, AGAIN = "out_of_order", 100  # samples after a stamp that goes back: a time that begins again
PERIOD_TOLERANCE = 0.1
NOISE_FACTOR = 1.5
GAP_SHARE = 1e-3  # of the steps
MISSING_SHARE = 0.01  # of the time, however few the gaps are
OUT_OF_RANGE_SHARE = 1e-3
OUTSIDE_GRID_SHARE = 0.02
MIN_T = 8.0  # of the rough bulk modulus, before its sign is believed
STIFFEST = 2.0  # of the upper bound: what is stiffer the other way is no oil, but the slow motion
MIN_CORRELATION = 0.2
BETA_DECADE = 30.0  # a rough bulk modulus this far outside the bounds is a wrong unit
BETWEEN_ROWS = "a quicker controller may have changed it meanwhile"
TOO_COARSE = "the grid is too coarse for the valve"
FEWEST_BLOCKS = 4  # of a map that is worth its name


@dataclass(frozen=True)
class Finding:
    """One sentence: level "error" (it would be learnt wrongly) or "warning", and the remedy."""

    level: str
    subject: str
    text: str
    remedy: str


@dataclass(frozen=True)
class Report:
    """All that a check found; SI, times in seconds."""

    duration_s: float
    samples: Timing
    messages: dict[str, Timing]
    signals: tuple[SignalReport, ...]
    motion: Motion
    coverage: tuple[Coverage, ...]
    refused: dict[str, int]
    findings: tuple[Finding, ...]
    learned: dict[str, int] | None = None  # blocks that become valid, by edge; None: not tried

    @property
    def ok(self) -> bool:
        """Whether nothing stands against learning from this trace."""
        return not any(finding.level == "error" for finding in self.findings)


def judge(
    model: Machine,
    assembly: Assembly,
    samples: Samples,
    series: tuple[Series, ...],
    messages: dict[str, Timing],
    refused: dict[str, int],
    stroke_m: float,
    jitter_s: float = 0.0,
) -> Report:
    """Judge samples and raw series (each signal at its own instants) against the declaration.

    jitter_s: of the stamps, where the samples have better ones.
    """
    signals = tuple(describe(series) for series in series)
    moved, covered = motion(model, samples), coverage(model, samples)
    findings = list(_timing(assembly, messages, samples, refused))
    findings += [_late(jitter_s)] if jitter_s else []
    if not assembly.messages:  # of a bus a command is what was sent
        findings += _commands(assembly, model, samples)
    timed = not any(finding.level == "error" for finding in findings)
    findings += _signals(model, series, signals)
    findings += _units(model, assembly, stroke_m, signals)
    if timed:  # samples put together with wrong periods say nothing about the machine
        findings += [*against_motion(model, moved), *_coverage(covered)]
    t_us = samples.t_us
    return Report(
        duration_s=float(t_us[-1] - t_us[0]) * 1e-6 if len(t_us) else 0.0,
        samples=timing(t_us),
        messages=messages,
        signals=signals,
        motion=moved,
        coverage=covered,
        refused=refused,
        findings=tuple(findings),
    )


def judge_recording(project: Project, read: Recording) -> Report:
    """Judge a recording against the project that it was read by."""
    assembly = (project.table_assembly if read.is_table else None) or project.assembly
    return judge(
        project.model, assembly, read.samples, read.series, read.messages, read.refused,
        project.sections.stroke_m, read.jitter_s,
    )  # fmt: skip


def with_learned(
    report: Report, learned: dict[str, int], finer: frozenset[str] = frozenset()
) -> Report:
    """The report with the valid blocks of each edge that a replay learned, and what they mean.

    A count of rows does not tell them: rows may stand at one place of a block, or along one line.
    finer: edges whose grid the replay had to make finer.
    """
    findings = [*report.findings, *map(_too_coarse, sorted(finer))]
    for covered in report.coverage:
        if covered.enough > 0 and learned.get(covered.edge, 0) < min(FEWEST_BLOCKS, covered.enough):
            findings.append(_few_learned(covered, learned.get(covered.edge, 0)))
    if not any(learned.values()):
        remedy = "record motion both ways at many commands, or give a coarser grid"
        findings.append(_error("maps", "replay learns no block of any valve", remedy))
    return replace(report, learned=learned, findings=tuple(findings))


def _too_coarse(edge: str) -> Finding:
    text = f"replay has halved intervals of its grid: {TOO_COARSE}"
    remedy = f"give u_grid and dp_grid of edges.{edge} narrower steps: on board they stay as given"
    return _warning(f"edges.{edge}", text, remedy)


def _few_learned(covered: Coverage, learned: int) -> Finding:
    """Few blocks in spite of many rows: a grid as wide as the motion, or a record too short."""
    subject = f"edges.{covered.edge}"
    text = (
        f"{covered.enough} blocks get {covered.min_rows} rows, but replay learns {learned} of them"
    )
    if covered.enough < FEWEST_BLOCKS:
        return replace(_too_coarse(covered.edge), text=f"{text}: {TOO_COARSE}")
    remedy = "record longer, and at more commands and loads; see the blocks with rtid replay"
    return _warning(subject, text, remedy)


def _error(subject: str, text: str, remedy: str) -> Finding:
    return Finding("error", subject, text, remedy)


def _warning(subject: str, text: str, remedy: str) -> Finding:
    return Finding("warning", subject, text, remedy)


def _timing(
    assembly: Assembly, messages: dict[str, Timing], samples: Samples, refused: dict[str, int]
) -> Iterator[Finding]:
    periods = {message.name: message.period_s for message in assembly.messages}
    for name, arrivals in messages.items():
        period_s = periods.get(name, arrivals.median_s)
        if arrivals.count == 0:
            yield _error(name, "does not occur in the trace", "check the DBC, id and channel")
        elif abs(arrivals.median_s - period_s) > PERIOD_TOLERANCE * period_s:
            text = f"arrives every {_ms(arrivals.median_s)}, declared {_ms(period_s)}"
            yield _error(
                name, text, f"set messages.{name}.period_ms = {1e3 * arrivals.median_s:.4g}"
            )
        if arrivals.gaps > GAP_SHARE * arrivals.count or arrivals.missing > MISSING_SHARE:
            text = f"{arrivals.gaps} of {arrivals.count} steps exceed {GAP_PERIODS} periods"
            text += f", at worst {_ms(arrivals.worst_s)}"
            text += f": {100 * arrivals.missing:.2g} % of the record is missing"
            yield _warning(name, text, "look for lost frames or rows: bus load, logger, wiring")
        if arrivals.backward:
            text, late = f"{arrivals.backward} time stamps go back", refused.get(LATE, 0)
            if late > AGAIN * arrivals.backward:
                text += f", and {late} samples are left out that are earlier than one before"
                remedy = "two records in one file? Part it where its time begins again, name both"
            else:
                remedy = "sort the log, or record with one clock"
            yield _warning(name, text, remedy)
    if spiked := refused.get(SPIKE, 0):
        text = f"{spiked} are left out: a sensor jumps away and back within milliseconds"
        yield _warning("samples", text, "look at the sensors' plugs, cables and messages")
    if refused.get(APART, 0):
        text = "rows tell signals in turn: between its values a sensor is taken on a line"
        remedy = "log all signals at one instant: what the oil does in between is left as a misfit"
        yield _warning("samples", text, remedy)
    if len(samples) == 0:
        remedy = "see the counters of refused frames; check counter, crc and data_id"
        yield _error("samples", "no complete sample could be made", remedy)


def _late(jitter_s: float) -> Finding:
    """Of stamps that a busy computer wrote: on board nothing is put back."""
    text = f"the logger stamps late by turns, by {_ms(jitter_s)} rms beside the usual delay"
    text += ": the sensors say that they were sampled evenly, and are taken so"
    return _warning("samples", text, "let the interface's hardware stamp, or write when it sampled")


def _commands(assembly: Assembly, model: Machine, samples: Samples) -> Iterator[Finding]:
    """Commands of a table that the controller may have changed between its rows."""
    for source in assembly.signals:
        if not source.command or source.hold != "zero" or source.constant is not None:
            continue
        signal = model.signals[model.column(source.name)]
        t_s = np.multiply(1e-6, samples.t_us)
        sd, step_s = unknown_between(t_s, samples.column(source.name))
        if sd > 0.0 and step_s >= FASTEST_S:
            text = f"is held for {_ms(step_s)} from row to row: {BETWEEN_ROWS}"
            remedy = f'if it has, set signals.{source.name}.hold = "linear" and its noise to up to '
            yield _warning(source.name, text, remedy + _shown(sd, signal))


def _signals(
    model: Machine, series: tuple[Series, ...], reports: tuple[SignalReport, ...]
) -> Iterator[Finding]:
    valued = (s for s, report in zip(series, reports, strict=True) if report.count)
    noises = noises_before(model, valued)
    for item, report in zip(series, reports, strict=True):
        signal = model.signals[model.column(item.name)]
        if report.count == 0:
            yield _error(item.name, "has no value at all", "check the signal's place in the DBC")
            continue
        yield from _values(signal, item, report)
        yield from _repeats(signal, item)
        noise = noises[item.name]
        yield from _filtered(signal, noise)
        yield from _noise(signal, replace(report, noise=noise.noise.sd))


def _values(signal: Signal, series: Series, report: SignalReport) -> Iterator[Finding]:
    x = series.value[np.isfinite(series.value)]
    outside = float(((x < signal.minimum) | (x > signal.maximum)).mean())
    if outside > 0:
        text = f"{100 * outside:.2g} % of its values lie outside the declared range"
        text += f" ({_shown(report.minimum, signal)} to {_shown(report.maximum, signal)})"
        remedy = f"correct unit or range of signals.{signal.name}"
        level = _error if outside > OUT_OF_RANGE_SHARE else _warning
        yield level(signal.name, text, remedy)
    if report.missing:
        text = f"{report.missing} values are marked not available"
        yield _warning(signal.name, text, "these samples are left out; check the sensor")
    if report.step == 0.0:
        text = f"never changes: {_shown(report.minimum, signal)} all the time"
        yield _warning(signal.name, text, "declare constant = ..., or check the sensor")
    elif signal.kind != "command" and report.frozen_s > 0 and report.noise > report.step:
        text = f"is frozen for {report.frozen_s:.3g} s from {report.frozen_from_s:.3g} s on"
        yield _error(signal.name, text, "leave this part out of [record]; check the sensor")


def _filtered(signal: Signal, noise: Coloured) -> Iterator[Finding]:
    """A sensor whose noise is that of a low-pass filter."""
    if noise.is_filtered:
        at = f" at about {noise.filtered_hz:.2g} Hz" if noise.filtered_hz else ""
        text = f"was filtered{at}: its noise is taken for {_shown(noise.noise.sd, signal)}"
        remedy = "log it unfiltered: what the filter delays is taken for a delay of the command"
        yield _warning(signal.name, text, remedy)


def _repeats(signal: Signal, series: Series) -> Iterator[Finding]:
    """A sensor that is slower than the rows in which it is written."""
    known = np.isfinite(series.value)
    rows = rows_per_value(series.value[known]) if signal.kind in SENSORS else 1.0
    if rows > 1.0:
        every_s = rows * 1e-6 * float(np.median(np.diff(series.t_us[known])))
        text = f"is sent every {_ms(every_s)} and repeated: rows where it changes"
        remedy = "log it at its own instants, or as often as the others"
        yield _warning(signal.name, text, remedy)


def _shown(value: float, signal: Signal) -> str:
    return with_unit(value, signal.unit)


def _noise(signal: Signal, report: SignalReport) -> Iterator[Finding]:
    """Declared against estimated noise; below the resolution nothing can be told."""
    expected = math.hypot(signal.noise, report.step / math.sqrt(12))
    if signal.noise == 0.0 or not report.noise > report.step / 2:
        return
    ratio = report.noise / expected
    if not 1 / NOISE_FACTOR < ratio < NOISE_FACTOR:
        text = (
            f"noise is {_shown(report.noise, signal)} rms, declared {_shown(signal.noise, signal)}"
        )
        remedy = f'set signals.{signal.name}.noise, or noise = "estimate"'
        yield _warning(signal.name, text, remedy)


def _units(
    model: Machine, assembly: Assembly, stroke_m: float, reports: tuple[SignalReport, ...]
) -> Iterator[Finding]:
    """Pressures against the grids, the position against the stroke: as if in another unit."""
    factors = {source.name: abs(source.factor) for source in assembly.signals}
    top_pa = max(float(edge.grid.dp_pa[-1]) for edge in model.edges)
    chambers = {chamber.pressure for chamber in model.chambers}
    sources = {edge.source for edge in model.edges}
    for report in reports:
        largest = max(abs(report.minimum), abs(report.maximum))
        if report.name == model.position:
            limits, dimension = (0.003 * stroke_m, 1.2 * stroke_m), "length"
        elif report.name in chambers:
            limits, dimension = (0.03 * top_pa, 2.5 * top_pa), "pressure"
        elif report.name in sources:
            limits, dimension = (0.1 * top_pa, 2.5 * top_pa), "pressure"
        elif model.signals[model.column(report.name)].kind == "pressure":
            limits, dimension = (1e3, 0.3 * top_pa), "pressure"
        else:
            continue
        declared = next(
            (u for u in units_of(dimension) if math.isclose(u.factor, factors[report.name])), None
        )
        meant = declared and looks_like(largest, *limits, declared)
        if declared and meant:
            text = (
                f"reaches {largest / declared.factor:.4g} {declared.name}: looks like {meant.name}"
            )
            yield _error(report.name, text, f'set signals.{report.name}.unit = "{meant.name}"')


def against_motion(model: Machine, result: Motion) -> Iterator[Finding]:
    """Signs, swapped pressures, stiffness and velocity that cannot be as declared."""
    yield from against_signs(model, result)
    yield from _stiffness(model, result)
    yield from _velocity(model, result)


def against_signs(model: Machine, result: Motion) -> Iterator[Finding]:
    """Signs and swapped pressures that cannot be as declared."""
    stiffest_pa = STIFFEST * model.beta_bounds_pa[1]
    clear = [s for s in result.springs.values() if abs(s.t) > MIN_T and -s.beta_pa < stiffest_pa]
    known = [s for s in clear if not result.is_too_slow(s)]
    soft = [s for s in known if s.t < 0]
    is_swapped = bool(known) and len(soft) == len(known)
    if not is_swapped and any(s.t < 0 for s in clear if result.is_too_slow(s)):
        yield _too_slow(result)  # unless a chamber that is quick enough says so
    against = result.u_to_v < -MIN_CORRELATION
    x = model.position
    if is_swapped:
        if against:
            text = f"{x} runs against command and pressures: its sign is reversed"
            yield _error(x, text, f"set signals.{x}.scale = -1 and offset = stroke")
        else:
            text = "pressure falls where the oil is compressed: the chambers' pressures are swapped"
            both = " and ".join(c.pressure for c in model.chambers)
            yield _error("chambers", text, f"swap {both}, or reverse command and position both")
    elif against:
        command = next(s.name for s in model.signals if s.kind == "command")
        text = f"the machine moves against {command}: its sign is reversed"
        if not known:
            text = f"the machine moves against {command}: the sign of {command} or {x} is reversed"
        yield _error(command, text, f"set signals.{command}.scale = -1, or turn the directions")
    elif soft:
        names = [name for name, s in result.springs.items() if s in soft]
        text = "pressure falls where the oil is compressed"
        yield _error(f"chambers.{names[0]}", text, "check its sign and its pressure signal")


def _too_slow(result: Motion) -> Finding:
    """Of a record whose oil settles between two samples: its pressures go either way."""
    settles_s = min(s.settles_s for s in result.springs.values() if result.is_too_slow(s))
    text = f"the oil settles within {_ms(settles_s)}, changes are seen over {_ms(result.window_s)}"
    text += ": the rate cannot tell the signs of the pressures"
    remedy = "record faster to have them judged; do not turn a sensor round for this"
    return _warning("chambers", text, remedy)


def _stiffness(model: Machine, moves: Motion) -> Iterator[Finding]:
    low, high = model.beta_bounds_pa
    for name, spring in moves.springs.items():
        is_seen = spring.t >= MIN_T  # NaN where nothing has moved
        if not is_seen or low / BETA_DECADE < spring.beta_pa < high * BETA_DECADE:
            continue
        text = f"a bulk modulus of about {limit(spring.beta_pa, 'Pa')} is impossible"
        remedy = "check the units of its pressure, of the position, and its area and volume"
        yield _error(f"chambers.{name}", text, remedy)


def _velocity(model: Machine, moves: Motion) -> Iterator[Finding]:
    names = [s.name for s in model.signals if s.kind == "velocity"]
    if not names or not math.isfinite(moves.v_slope) or abs(moves.v_slope - 1) < 0.1:
        return
    reversed_x = moves.u_to_v < -MIN_CORRELATION and moves.v_slope < 0
    text = f"is {moves.v_slope:.3g} times the derivative of {model.position}"
    remedy = f"check unit and sign of signals.{model.position if reversed_x else names[0]}"
    yield _error(names[0], text, remedy)


def _coverage(coverages: tuple[Coverage, ...]) -> Iterator[Finding]:
    for covered in coverages:
        subject = f"edges.{covered.edge}"
        if covered.open_s == 0:
            remedy = "check direction and command, or record motion both ways"
            yield _error(subject, "never opens in this trace", remedy)
        elif covered.enough == 0:
            remedy = "coarser grid, longer record, or borders where the machine works"
            yield _error(subject, f"no block gets {covered.min_rows} rows", remedy)
        if covered.reverse > 0.5:
            text = f"dp is negative {100 * covered.reverse:.0f} % of the open time"
            yield _error(subject, text, "swap source and sink, or check both pressures")
        elif covered.outside > OUTSIDE_GRID_SHARE:
            text = f"{100 * covered.outside:.0f} % of its open time lies outside the grid: command"
            low, high = (with_unit(dp, "Pa") for dp in covered.dp_pa)
            text += f" {covered.w_v[0]:.3g} to {covered.w_v[1]:.3g}, dp {low} to {high}"
            yield _warning(subject, text, f"widen u_grid or dp_grid of {subject}")
        if covered.below > OUTSIDE_GRID_SHARE:
            text = (
                f"the command is below its grid for {100 * covered.below:.0f} % of the "
                f"record, and no"
            )
            text += " safe_band says that the valve is shut there: nothing is learned meanwhile"
            yield _warning(subject, text, f"give {subject}.safe_band, or a u_grid down to there")


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"
