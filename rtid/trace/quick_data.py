"""Is this record good enough?  Rates, gaps, saturation, coverage and excitation, in sentences.

`rtid.trace` judges the declaration against the record; here the record is judged for what it can
teach: something that stands against it blocks the verdict, a reservation only weakens it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from firmware_bridge.samples import ROW
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.trace.check import BETWEEN_ROWS, Report
from rtid.trace.quick_source import NEEDED
from rtid.trace.series import SignalReport
from rtid.trace.signals import Recording

LEAST_S, FEW_S = 10.0, 30.0
LEAST_HZ, FEW_HZ = 10.0, 200.0  # rows per second
SLOW_HZ = 2.0  # so slow is a table whose time in ms is taken for one in s
ENOUGH = "a minute or two, every signal as often as the controller has it"
FEW_BLOCKS = 10  # of one valve, with enough rows
STILL = 0.02  # of the whole way of the position: it stands
AT_END = 0.01  # share of the samples at one and the same extreme value
HELD_STILL = 0.05  # share of the time with shut valves that tells leaks from maps
VARIED = 0.05  # of its mean: from which on a supply is said to vary
STEP_SHARE, STEP_S = 0.1, 0.02  # a step: so much of the command's range within so long
FEW_STEPS = 5
FROZEN = "is frozen"  # in a finding of `rtid check`
SETTLES_S = 0.1  # of frozen samples before which a command may still have moved

GOOD, FAIR, BAD = "good", "fair", "bad"


@dataclass(frozen=True)
class Point:
    """One point of the judgement: its level, what was found, and what to record instead."""

    level: str
    text: str
    remedy: str = ""


def points(
    model: Machine, trace: Recording, report: Report, supply_is_given: bool = False
) -> list[Point]:
    """Everything that speaks for or against a record, in the order of reading.

    supply_is_given: its pressure, which no sensor tells, by the user.
    """
    return [
        *_size(trace, report),
        *_frozen(trace),
        *_objections(trace, report),
        *_ends(model, trace),
        *_coverage(report),
        *_excitation(model, trace, supply_is_given),
    ]


def level_of(saids: list[Point]) -> str:
    """The level of the whole: that of the worst point."""
    levels = [point.level for point in saids]
    return BAD if BAD in levels else FAIR if FAIR in levels else GOOD


def _size(trace: Recording, report: Report) -> Iterator[Point]:
    rows = int(((trace.samples.flags & ROW) != 0).sum())
    rate = rows / report.duration_s if report.duration_s > 0 else 0.0
    text = f"{report.duration_s:.1f} s with {rate:.0f} positions per second"
    if report.duration_s < LEAST_S or rate < LEAST_HZ:
        in_ms = ', or name the unit of its time, "t [ms]"' * (trace.is_table and rate <= SLOW_HZ)
        yield Point(BAD, f"{text}: too little", f"record {ENOUGH}{in_ms}")
    elif report.duration_s < FEW_S or rate < FEW_HZ:
        yield Point(FAIR, f"{text}: stiffness and timing show coarsely", f"record {ENOUGH}")
    else:
        yield Point(GOOD, text)
    worst = max((t for t in trace.messages.values()), key=lambda t: t.gaps, default=None)
    if worst is not None and worst.gaps == 0 and worst.backward == 0:
        yield Point(GOOD, "no gaps")


def _frozen(trace: Recording) -> Iterator[Point]:
    """Signals without which nothing can be learned, and which never change."""
    for name in NEEDED:
        if len(trace.samples) and np.ptp(trace.samples.column(name)) == 0.0:
            yield Point(BAD, f"{name} never changes", "check its sensor, and what was taken for it")


def _objections(trace: Recording, report: Report) -> Iterator[Point]:
    """What `rtid check` finds, less what is the grid's fault, said above, or said of nothing.

    A signal that is frozen while the command rests too has been held, or computed: it stands
    still, as the machine does.
    """
    resting = {s.name for s in report.signals if _is_commanded_to_rest(trace, s)}
    # of a command between rows the fit tells itself
    apart = ("outside the grid", "never changes", "of about nan", BETWEEN_ROWS)
    for finding in report.findings:
        if not any(known in finding.text for known in apart):
            is_rest = FROZEN in finding.text and finding.subject in resting
            level = BAD if finding.level == "error" and not is_rest else FAIR
            yield Point(level, f"{finding.subject}: {finding.text}", finding.remedy)


def _is_commanded_to_rest(trace: Recording, signal: SignalReport) -> bool:
    """True where the command stands still over the longest span in which a signal is frozen."""
    samples = trace.samples
    at_s = 1e-6 * (samples.t_us - samples.t_us[0]) - signal.frozen_from_s
    u = samples.column("u")[(at_s > SETTLES_S) & (at_s < signal.frozen_s)]
    return len(u) > 0 and float(np.ptp(u)) == 0.0


def _ends(model: Machine, trace: Recording) -> Iterator[Point]:
    """Sensors and commands that stand at the end of their range."""
    for signal in model.signals:
        if signal.kind not in ("command", "pressure"):
            continue
        values = trace.samples.column(signal.name)
        if np.ptp(values) == 0.0:
            continue
        ends = (float(values.min()), float(values.max()))
        share, end = max((float((values == end).mean()), end) for end in ends)
        is_off = signal.kind == "command" and _is_off(model, trace, values, end)
        if share > AT_END and (is_off or _rests_at_end(values)):
            text = f"{signal.name} stands at its end value {100 * share:.1f} % of the time"
            what = "command less" if signal.kind == "command" else "is the sensor's range enough?"
            if is_off:
                text += ", and nothing moves meanwhile"
                what += "; if the machine was off, cut that out: the maps learn no flow there"
            yield Point(FAIR, text, what)


def _is_off(model: Machine, trace: Recording, u: FloatArray, end: float) -> bool:
    """Whether the machine stands wherever the command u (n,) is at this end, which is not zero."""
    x = trace.samples.column(model.position)
    return bool(abs(end) > AT_END * np.ptp(u) and np.ptp(x[u == end]) <= STILL * np.ptp(x))


def _rests_at_end(values: FloatArray) -> bool:
    """True where the end is no usual value, as zero is for a command that rests."""
    usual = float(np.median(values))
    return usual not in (values.min(), values.max())


def _coverage(report: Report) -> Iterator[Point]:
    counts = {coverage.edge: coverage.enough for coverage in report.coverage}
    text = ", ".join(f"{edge} {count}" for edge, count in counts.items())
    few = [edge for edge, count in counts.items() if count < FEW_BLOCKS]
    if few:
        remedy = f"move {' and '.join(few)} at small and large openings, with changing load"
        yield Point(FAIR, f"blocks with enough data, by valve: {text}", remedy)
    else:
        yield Point(GOOD, f"blocks with enough data, by valve: {text}")


def _excitation(model: Machine, trace: Recording, supply_is_given: bool) -> Iterator[Point]:
    samples = trace.samples
    u = samples.column("u")
    band = model.edges[0].safe_band_v
    shut = float((np.abs(u) <= band).mean())
    if shut < HELD_STILL:
        text = f"the valves are shut {100 * shut:.1f} % of the time: leaks may hide in the maps"
        yield Point(FAIR, text, "hold still under load for a few seconds now and then")
    else:
        yield Point(GOOD, f"the valves are shut {100 * shut:.0f} % of the time: leaks can show")
    steps = _steps(np.asarray(samples.t_us * 1e-6, np.float64), u)
    if steps < FEW_STEPS:
        text = f"{steps} steps of the command: stiffness and timing show little"
        yield Point(FAIR, text, "add steps of the command, some ten per minute")
    else:
        yield Point(GOOD, f"{steps} steps of the command")
    supply = samples.column("p_supply")
    swing = float(np.ptp(np.quantile(supply, [0.01, 0.99]))) / max(float(np.mean(supply)), 1.0)
    if swing == 0.0:
        text = "nothing tells what the supply does: a sag, and external leaks, may hide in the maps"
        or_say = "" if supply_is_given else ", or say it with --supply MPA"
        yield Point(FAIR, text, f"log its pressure{or_say}")
    elif swing < VARIED:
        text = f"the supply stays within {100 * swing:.1f} %: external leaks may hide in the maps"
        yield Point(FAIR, text, "record part of the motion at another supply pressure")
    else:
        yield Point(GOOD, f"the supply varies by {100 * swing:.0f} %")


def _steps(t_s: FloatArray, u: FloatArray) -> int:
    """Number of quick changes of the command."""
    if len(u) < 3 or np.ptp(u) == 0:
        return 0
    n = max(1, round(STEP_S / max(float(np.median(np.diff(t_s))), 1e-9)))
    quick = np.abs(u[n:] - u[:-n]) > STEP_SHARE * np.ptp(u)
    return int((quick[1:] & ~quick[:-1]).sum() + quick[:1].sum())
