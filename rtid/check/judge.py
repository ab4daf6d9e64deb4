"""Judge a project against a trace: arrays in, `Report` out, ending in sentences with remedies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from firmware_bridge.config import Assembly
from firmware_bridge.samples import Samples
from rtid.check.coverage import Coverage, coverage
from rtid.check.plausible import Motion, looks_like, motion
from rtid.check.series import Series, SignalReport, describe
from rtid.check.timing import GAP_PERIODS, Timing, timing
from rtid.model import Model, Signal
from rtid.units import units_of

PERIOD_TOLERANCE = 0.1
NOISE_FACTOR = 1.5
GAP_SHARE = 1e-3
OUT_OF_RANGE_SHARE = 1e-3
OUTSIDE_GRID_SHARE = 0.02
MIN_T = 8.0  # of the rough bulk modulus, before its sign is believed
MIN_CORRELATION = 0.2
BETA_DECADE = 30.0  # a rough bulk modulus this far outside the bounds is a wrong unit
MOVED_SHARE = 0.01


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

    @property
    def ok(self) -> bool:
        """Whether nothing stands against learning from this trace."""
        return not any(finding.level == "error" for finding in self.findings)


def judge(
    model: Model,
    assembly: Assembly,
    samples: Samples,
    series: tuple[Series, ...],
    messages: dict[str, Timing],
    refused: dict[str, int],
    stroke_m: float,
) -> Report:
    """Judge samples and raw series (each signal at its own instants) against the declaration."""
    signals = tuple(describe(one) for one in series)
    moved, covered = motion(model, samples), coverage(model, samples)
    findings = list(_timing(assembly, messages, samples))
    timed = not any(finding.level == "error" for finding in findings)
    findings += _signals(model, series, signals)
    findings += _units(model, assembly, stroke_m, signals)
    if timed:  # samples put together with wrong periods say nothing about the machine
        findings += [*_motion(model, moved), *_coverage(covered)]
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


def _error(subject: str, text: str, remedy: str) -> Finding:
    return Finding("error", subject, text, remedy)


def _warning(subject: str, text: str, remedy: str) -> Finding:
    return Finding("warning", subject, text, remedy)


def _timing(assembly: Assembly, messages: dict[str, Timing], samples: Samples) -> Iterator[Finding]:
    periods = {message.name: message.period_s for message in assembly.messages}
    for name, found in messages.items():
        period_s = periods.get(name, found.median_s)
        if found.count == 0:
            yield _error(name, "does not occur in the trace", "check the DBC, id and channel")
        elif abs(found.median_s - period_s) > PERIOD_TOLERANCE * period_s:
            text = f"arrives every {_ms(found.median_s)}, declared {_ms(period_s)}"
            yield _error(name, text, f"set messages.{name}.period_ms = {1e3 * found.median_s:.4g}")
        if found.gaps > GAP_SHARE * found.count:
            text = f"{found.gaps} of {found.count} steps exceed {GAP_PERIODS} periods"
            text += f", at worst {_ms(found.worst_s)}"
            yield _warning(name, text, "look for lost frames: bus load, logger, wiring")
        if found.backward:
            text = f"{found.backward} time stamps go back"
            yield _warning(name, text, "sort the log, or record with one clock")
    if len(samples) == 0:
        remedy = "see the counters of refused frames; check counter, crc and data_id"
        yield _error("samples", "no complete sample could be made", remedy)


def _signals(
    model: Model, series: tuple[Series, ...], reports: tuple[SignalReport, ...]
) -> Iterator[Finding]:
    for one, report in zip(series, reports, strict=True):
        signal = model.signals[model.column(one.name)]
        if report.count == 0:
            yield _error(one.name, "has no value at all", "check the signal's place in the DBC")
            continue
        yield from _values(signal, one, report)
        yield from _noise(signal, report)


def _values(signal: Signal, series: Series, report: SignalReport) -> Iterator[Finding]:
    x = series.value[np.isfinite(series.value)]
    outside = float(((x < signal.minimum) | (x > signal.maximum)).mean())
    if outside > 0:
        text = f"{100 * outside:.2g} % of its values lie outside the declared range"
        text += f" ({report.minimum:.4g} to {report.maximum:.4g} {signal.unit})"
        remedy = f"correct unit or range of signals.{signal.name}"
        level = _error if outside > OUT_OF_RANGE_SHARE else _warning
        yield level(signal.name, text, remedy)
    if report.missing:
        text = f"{report.missing} values are marked not available"
        yield _warning(signal.name, text, "these samples are left out; check the sensor")
    if report.step == 0.0:
        text = f"never changes: {report.minimum:.6g} {signal.unit} all the time"
        yield _warning(signal.name, text, "declare constant = ..., or check the sensor")
    elif signal.kind != "command" and report.frozen_s > 0 and report.noise > report.step:
        text = f"is frozen for {report.frozen_s:.3g} s from {report.frozen_from_s:.3g} s on"
        yield _error(signal.name, text, "leave this part out of [record]; check the sensor")


def _noise(signal: Signal, report: SignalReport) -> Iterator[Finding]:
    """Declared against estimated noise; below the resolution nothing can be told."""
    expected = math.hypot(signal.noise, report.step / math.sqrt(12))
    if signal.noise == 0.0 or not report.noise > report.step / 2:
        return
    ratio = report.noise / expected
    if not 1 / NOISE_FACTOR < ratio < NOISE_FACTOR:
        text = f"noise is {report.noise:.3g} {signal.unit} rms, declared {signal.noise:.3g}"
        remedy = f'set signals.{signal.name}.noise, or noise = "estimate"'
        yield _warning(signal.name, text, remedy)


def _units(
    model: Model, assembly: Assembly, stroke_m: float, reports: tuple[SignalReport, ...]
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


def _motion(model: Model, found: Motion) -> Iterator[Finding]:
    known = [s for s in found.springs.values() if abs(s.t) > MIN_T]
    soft = [s for s in known if s.t < 0]
    against = found.u_to_v < -MIN_CORRELATION
    x = model.position
    if known and len(soft) == len(known):
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
        names = [name for name, s in found.springs.items() if s.t < -MIN_T]
        text = "pressure falls where the oil is compressed"
        yield _error(f"chambers.{names[0]}", text, "check its sign and its pressure signal")
    yield from _stiffness(model, found)
    yield from _velocity(model, found)


def _stiffness(model: Model, found: Motion) -> Iterator[Finding]:
    low, high = model.beta_bounds_pa
    for name, spring in found.springs.items():
        if spring.t < MIN_T or low / BETA_DECADE < spring.beta_pa < high * BETA_DECADE:
            continue
        text = f"a bulk modulus of about {spring.beta_pa:.1g} Pa is impossible"
        remedy = "check the units of its pressure, of the position, and its area and volume"
        yield _error(f"chambers.{name}", text, remedy)


def _velocity(model: Model, found: Motion) -> Iterator[Finding]:
    names = [s.name for s in model.signals if s.kind == "velocity"]
    if not names or not math.isfinite(found.v_slope) or abs(found.v_slope - 1) < 0.1:
        return
    reversed_x = found.u_to_v < -MIN_CORRELATION and found.v_slope < 0
    text = f"is {found.v_slope:.3g} times the derivative of {model.position}"
    remedy = f"check unit and sign of signals.{model.position if reversed_x else names[0]}"
    yield _error(names[0], text, remedy)


def _coverage(found: tuple[Coverage, ...]) -> Iterator[Finding]:
    for one in found:
        subject = f"edges.{one.edge}"
        if one.open_s == 0:
            remedy = "check direction and command, or record motion both ways"
            yield _error(subject, "never opens in this trace", remedy)
        elif one.enough == 0:
            remedy = "coarser grid, longer record, or borders where the machine works"
            yield _error(subject, f"no block gets {one.min_rows} rows", remedy)
        if one.reverse > 0.5:
            text = f"dp is negative {100 * one.reverse:.0f} % of the open time"
            yield _error(subject, text, "swap source and sink, or check both pressures")
        elif one.outside > OUTSIDE_GRID_SHARE:
            text = f"{100 * one.outside:.0f} % of its open time lies outside the grid: command"
            text += f" {one.w_v[0]:.3g} to {one.w_v[1]:.3g}, dp {1e-6 * one.dp_pa[0]:.3g} to"
            text += f" {1e-6 * one.dp_pa[1]:.3g} MPa"
            yield _warning(subject, text, f"widen u_grid or dp_grid of {subject}")
        if one.below > OUTSIDE_GRID_SHARE:
            text = (
                f"the command is below its grid for {100 * one.below:.0f} % of the record, and no"
            )
            text += " safe_band says that the valve is shut there: nothing is learned meanwhile"
            yield _warning(subject, text, f"give {subject}.safe_band, or a u_grid down to there")


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"
