"""A machine of which nobody has said anything: given sizes, stated assumptions, grids of the data.

What nobody has said is assumed, and every assumption is kept with what would change if it is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from firmware_bridge.samples import ROW, Samples
from rtid.plain import FloatArray
from rtid.project.guess import RoleCandidate
from rtid.project.template import EDGES, nice
from rtid.study.quick_band import MOVES, creep, neutral_within, settled, shut_band
from rtid.study.spans import HELD_OUT_SHARE
from rtid.trace.neutral import last_part_from
from rtid.trace.quick_source import is_motor, unit_of
from rtid.units import Unit

BORE_M, ROD_SHARE, DEAD_SHARE = 0.05, 0.7, 0.2  # a usual cylinder
TURN_M3, DEAD_TURNS = 50e-6, 10.0  # a usual motor's displacement; its sides and lines, in turns
SUPPLY_PA = 7e6
U_STEPS, DP_STEPS = 24, 12  # with 16 along u a healthy machine left 1.2 times its noise
RATED_DP_PA = 5e5  # as data sheets have it
MOST_POWER = 2.0  # of the opening, that a valve's gain is taken to follow beyond the record
WIDE = 0.5  # of the largest command beyond the dead band: from there on a valve is wide open
LEAST_FLOW = 1e-7  # m3/s
WINDOW_S = 0.02  # over which the speed is taken
STROKE_S = 0.05  # over which a position is taken, to tell how far it goes
LAG_MS, LAG_TOLERANCE_MS = 2.0, 5.0  # of a spool: every real one has some lag
LAG_SHARE = 0.2  # by which a data sheet's lag may be off
LONGEST_S = 1e6  # of a record, seconds: behind a damaged stamp nothing is looked for
MOST_S = 120.0  # of a record: a diagnosis of more takes longer than a minute


@dataclass(frozen=True)
class Given:
    """What the user has said, SI, the safe band in the command's unit; None: nothing."""

    bore_m: float | None = None
    rod_m: float | None = None
    stroke_m: float | None = None
    dead_volumes_m3: tuple[float, float] | None = None
    safe_band: float | None = None
    lag_s: float | None = None
    supply_pa: float | None = None


@dataclass(frozen=True)
class Assumption:
    """Something that nobody has said, and what it would change if it is wrong."""

    what: str
    if_wrong: str


@dataclass(frozen=True)
class MachineSizes:
    """Sizes and grids, SI; reversed: roles to be turned round.

    spans_s: the part of the record that teaches, and the one that judges; empty: not looked at yet.
    goes_round: a motor, whose x is an angle.  command_hold, command_noise: how the command runs
    between its samples, and what is unknown of it there, in SI; command_step_s: from one to
    the next of a sample of a faster one, which may act up to half of it later than on the line.
    command_late_rows: by how many rows the log writes it late.  pressures_from_air: what sensors
    say counts from the air, though their unit does not say so.
    command_unit: that of its column.  noise_seen: 1 sigma by role, as the record tells it.
    supply_pa: of a supply that is not measured, as it was said.  extra_volumes: dead volume of each
    chamber beyond the assumed one, as fitted, m3, with its standard deviation.  lag_seen_s: as the
    record tells it, None where it does not.  u_zero: what the command is counted from.
    """

    bore_m: float
    rod_m: float
    stroke_m: float
    dead_volumes_m3: tuple[float, float]
    dead_is_fitted: bool
    x_zero_m: float
    u_grid: FloatArray
    dp_grid_pa: FloatArray
    safe_band: float | None
    lag_s: float | None
    rated_flow_m3s: float
    command_unit: Unit
    spans_s: tuple[tuple[float, float], ...] = ()
    reversed: frozenset[str] = frozenset()
    assumptions: tuple[Assumption, ...] = field(default=())
    goes_round: bool = False
    command_hold: str = "zero"
    command_noise: float = 0.0
    command_step_s: float = 0.0
    command_late_rows: int = 0
    pressures_from_air: bool = False
    noise_seen: Mapping[str, float] = field(default_factory=dict)
    supply_pa: float | None = None
    extra_volumes: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    lag_seen_s: float | None = None
    u_zero: float = 0.0

    @property
    def displacement_m3(self) -> float:
        """What a turn of a motor takes, whose bore is of the area of that over 2 pi."""
        return math.tau * math.pi / 4 * self.bore_m**2


def lag_of(machine: MachineSizes) -> tuple[float, float]:
    """The spools' lag and its tolerance, ms, with what a sample of a faster command may act late.

    A controller that changes it n times a sample acts 1 / 2n of one later than on the line: of what
    is even from 0 to a half the standard deviation is a quarter over the root of 3.
    """
    lag_ms, tolerance_ms = LAG_MS, LAG_TOLERANCE_MS
    if machine.lag_s is not None:
        lag_ms, tolerance_ms = 1e3 * machine.lag_s, 1e3 * LAG_SHARE * machine.lag_s
    quarter_ms = 250.0 * machine.command_step_s
    return lag_ms + quarter_ms, math.hypot(tolerance_ms, quarter_ms / math.sqrt(3.0))


def first_machine(
    roles: dict[str, RoleCandidate], given: Given, u_zero: float = 0.0
) -> MachineSizes:
    """The machine from the ranges of its signals alone, as far as it takes to read the samples.

    u_zero: what its command is counted from, SI.
    """
    first = _first_motor if is_motor(roles) else _first_cylinder
    return first(roles, given, u_zero)


def _first_motor(roles: dict[str, RoleCandidate], given: Given, u_zero: float) -> MachineSizes:
    volumes = given.dead_volumes_m3
    as_cylinder = replace(given, bore_m=math.sqrt(2.0 * TURN_M3) / math.pi, rod_m=0.0, stroke_m=1.0,
                          dead_volumes_m3=volumes or 2 * (DEAD_TURNS * TURN_M3,))  # fmt: skip
    first = _first_cylinder(roles, as_cylinder, u_zero)
    assumptions = (*_of_displacement(), *_of_dead_volumes(volumes is None))
    return replace(
        first,
        x_zero_m=0.0,
        dead_is_fitted=volumes is None,
        goes_round=True,
        assumptions=tuple(assumptions),
    )


def _of_displacement() -> Iterator[Assumption]:
    yield Assumption(
        f"a turn of the motor takes {1e6 * TURN_M3:.0f} cm3 (displacement_cm3 in the file)",
        "every flow, leak and map is scaled by the true one over this one; the verdict stays",
    )


def _of_dead_volumes(are_fitted: bool) -> Iterator[Assumption]:
    if are_fitted:
        yield Assumption(
            "the dead volumes are whatever explains the record best (--dead-volume)",
            "extra dead volume and hoses cannot be told from it, and are not judged",
        )


def _first_cylinder(roles: dict[str, RoleCandidate], given: Given, u_zero: float) -> MachineSizes:
    bore = given.bore_m or BORE_M
    rod = given.rod_m if given.rod_m is not None else ROD_SHARE * bore
    x, u = roles["x"], roles["u"]
    low, high = (unit_of(x).si(end) for end in (x.low, x.high))
    zero = min(low, 0.0)
    stroke = given.stroke_m or nice(high - zero, 1.0)
    swept = math.pi / 4 * bore**2 * stroke
    u_max = nice(max(abs(unit_of(u).factor * end - u_zero) for end in (u.low, u.high)), 10.0)
    highest = max(unit_of(c).si(c.high) for r, c in roles.items() if r.startswith("p_"))
    top = nice(highest, SUPPLY_PA)
    return MachineSizes(
        bore,
        rod,
        stroke,
        given.dead_volumes_m3 or (DEAD_SHARE * swept, DEAD_SHARE * swept),
        given.dead_volumes_m3 is None,
        zero,
        np.linspace(0.0, u_max, U_STEPS + 1),
        top * np.linspace(-1.0, 1.0, DP_STEPS + 1),
        None if given.safe_band is None else unit_of(u).factor * given.safe_band,
        given.lag_s,
        LEAST_FLOW,
        unit_of(u),
        assumptions=tuple(_of_geometry(given, bore, rod, stroke, zero)),
        supply_pa=given.supply_pa,
        u_zero=u_zero,
    )


def _of_geometry(
    given: Given, bore: float, rod: float, stroke: float, zero: float
) -> list[Assumption]:
    assumptions = []
    if given.bore_m is None:
        assumptions.append(Assumption(
            f"the bore is {1e3 * bore:.0f} mm (--bore)",
            "every flow, leak and map is scaled by the true area over this one; the verdict stays",
        ))  # fmt: skip
    if given.rod_m is None:
        assumptions.append(Assumption(
            f"the rod is {1e3 * rod:.0f} mm (--rod)",
            "flows of chamber b are scaled against those of a: an internal leak would look partly "
            "like an external one",
        ))  # fmt: skip
    fitted = given.dead_volumes_m3 is None
    volumes = (
        "the volume of b is off by a constant, which is fitted with it"
        if fitted
        else "the volume of b is off: as if it had extra dead volume"
    )
    if given.stroke_m is None:
        assumptions.append(Assumption(
            f"the stroke is {1e3 * stroke:.0f} mm, from the largest position (--stroke)",
            volumes,
        ))  # fmt: skip
    if zero < 0.0:
        assumptions.append(Assumption(
            f"the piston is fully retracted at x = {1e3 * zero:.0f} mm, the lowest seen",
            volumes.replace("volume of b is", "volumes are"),
        ))  # fmt: skip
    return [*assumptions, *_of_dead_volumes(fitted)]


def counted_from(samples: Samples) -> float:
    """The neutral of a command of one sign that drives both ways, SI; 0 of any other."""
    return neutral_within(samples.column("u"), _speed(samples))


def fitted_machine(machine: MachineSizes, samples: Samples) -> MachineSizes:
    """The machine with grids, dead band, flow and span from the samples, as its signs are."""
    u, x = samples.column("u"), samples.column("x")
    speed, is_settled = _speed(samples), settled(u, np.asarray(samples.t_us * 1e-6, np.float64))
    span, at_rest_mps = _span(samples, x), creep(u, speed, is_settled)
    band = machine.safe_band
    if band is None:
        band = shut_band(u, speed, is_settled)
    top = float(np.abs(u).max())
    drops = [
        samples.column(source)[w > band] - samples.column(sink)[w > band]
        for source, sink, way in EDGES.values()
        for w in [way * u]
    ]
    dp = np.concatenate(drops) if any(len(d) for d in drops) else np.zeros(1)
    low, high = float(dp.min()), float(dp.max())
    return replace(
        machine,
        u_grid=np.linspace(band, max(top, band + 1e-6) * 1.001, U_STEPS + 1),
        dp_grid_pa=dp_grid(low, high),
        safe_band=band,
        rated_flow_m3s=rated_flow(machine, samples, np.abs(speed), band),
        spans_s=_teach_and_judge(samples, x, span),
        assumptions=(
            *machine.assumptions,
            *_of_samples(samples, machine, band, span),
            *_of_creep(at_rest_mps, speed, machine.goes_round),
        ),
    )


def _of_samples(
    samples: Samples, machine: MachineSizes, band: float, span: tuple[float, float] | None
) -> list[Assumption]:
    assumptions = []
    if machine.safe_band is None:
        assumptions.append(of_band(band, machine.command_unit))
    if machine.lag_s is None:
        assumptions.append(Assumption(
            f"the spools lag {LAG_MS:g} ms, give or take {LAG_TOLERANCE_MS:g} (--lag)",
            "a smaller delay is counted as the spools' own",
        ))  # fmt: skip
    if span is not None:
        whole = float(samples.t_us[-1] - samples.t_us[0]) * 1e-6
        assumptions.append(Assumption(
            f"of {whole:.0f} s the {MOST_S:.0f} s with the most motion are looked at, "
            f"{span[0]:.0f} to {span[1]:.0f} s",
            "what happens elsewhere in the record is not seen",
        ))  # fmt: skip
    return assumptions


def of_band(
    band: float, unit: Unit, why: str = "half of what it takes to move or less"
) -> Assumption:
    """That the valves are shut up to a command, SI; below 0 they stand open at rest."""
    size = f"{band / unit.factor:.3g} {unit.name}"
    where = f"up to |u| = {size}" if band >= 0.0 else f"from {size} of the other direction on"
    return Assumption(
        f"the valves are shut {where}, {why} (--safe-band)",
        "a valve that opens earlier passes for a leak",
    )


def _of_creep(at_rest_mps: float, speed: FloatArray, goes_round: bool) -> Iterator[Assumption]:
    """What moves the machine while nothing is commanded; speed (n,): dx/dt, m/s or rad/s."""
    if abs(at_rest_mps) <= MOVES * float(np.quantile(np.abs(speed), 0.99)):
        return
    way = "falls" if at_rest_mps < 0.0 else "rises"
    how_fast = (
        f"{abs(at_rest_mps):.3g} rad/s" if goes_round else f"{1e3 * abs(at_rest_mps):.2g} mm/s"
    )
    yield Assumption(
        f"x {way} by {how_fast} while nothing is commanded, as a load does that sinks by a leak",
        "a valve is open at rest, and no band of the command is shut (--safe-band 0)",
    )


def rated_flow(machine: MachineSizes, samples: Samples, speed: FloatArray, band: float) -> float:
    """Flow of the largest valve, fully open at RATED_DP_PA, m3/s: what a data sheet would say.

    speed (n,) in m/s; machine: its grid still ends at the largest command that the signal can have.
    A valve that was not opened so far opens on as it did: Q / sqrt(dp) as a power of the opening.
    """
    u, full, flows = samples.column("u"), float(machine.u_grid[-1]), [LEAST_FLOW]
    for name, (source, sink, way) in EDGES.items():
        w, dp = way * u, samples.column(source) - samples.column(sink)
        wide = (w > band + WIDE * (w.max() - band)) & (w > band) & (dp > 0.0)
        if wide.any():
            gain = _at_full(w[wide] - band, speed[wide] / np.sqrt(dp[wide]), full - band)
            rod = machine.rod_m if "b" in name else 0.0
            area = math.pi / 4 * (machine.bore_m**2 - rod**2)
            flows.append(area * gain * math.sqrt(RATED_DP_PA))
    return max(flows)


def _at_full(opening: FloatArray, gain: FloatArray, full: float) -> float:
    """A gain (n,) that is a power of the opening (n,), at the full one: from medians of halves."""
    is_far = opening >= np.median(opening)
    near, far = (
        (float(np.median(opening[half])), float(np.median(gain[half])))
        for half in (~is_far if not is_far.all() else is_far, is_far)
    )
    power = 1.0
    if far[0] > near[0] and min(near[1], far[1]) > 0.0:
        power = math.log(far[1] / near[1]) / math.log(far[0] / near[0])
    return far[1] * (full / far[0]) ** min(max(power, 0.0), MOST_POWER)


def _speed(samples: Samples) -> FloatArray:
    """dx/dt at every sample (n,), over WINDOW_S."""
    t, x = samples.t_us * 1e-6, samples.column("x")
    rows = np.flatnonzero(samples.flags & ROW)
    if len(rows) < 3:
        return np.zeros(len(t))
    step = max(1, round(WINDOW_S / max(float(np.median(np.diff(t[rows]))), 1e-9)))
    at = rows[::step]
    if len(at) < 2:
        return np.zeros(len(t))
    speed = np.diff(x[at]) / np.maximum(np.diff(t[at]), 1e-9)
    return np.asarray(speed[np.clip(np.searchsorted(at, np.arange(len(t))) - 1, 0, len(speed) - 1)])


def dp_grid(low: float, high: float) -> FloatArray:
    """Borders (n,), Pa, from below `low` to above `high`: narrow near 0, where flow bends most."""
    top = nice(max(high, 1e5), SUPPLY_PA)
    up = top * np.linspace(0.0, 1.0, DP_STEPS + 1) ** 2
    if low >= -0.02 * top:
        return np.concatenate([[low - 1e4], up[1:]]) if low < 0.0 else up
    down = -nice(-low, SUPPLY_PA) * np.linspace(1.0, 0.0, DP_STEPS // 2 + 1) ** 2
    return np.concatenate([down, up[1:]])


def _teach_and_judge(
    samples: Samples, x: FloatArray, span: tuple[float, float] | None
) -> tuple[tuple[float, float], ...]:
    """The parts that teach and judge, by motion; span: of the record, None for all of it."""
    t = (samples.t_us - samples.t_us[0]) * 1e-6
    begin, end = span or (0.0, math.floor(t[-1]) + 1.0)
    inside = (t >= begin) & (t <= end)
    if inside.sum() < 3:
        return ()
    split = round(last_part_from(t[inside], x[inside], HELD_OUT_SHARE), 3)
    return (begin, split), (split, end)


def _span(samples: Samples, x: FloatArray) -> tuple[float, float] | None:
    """The MOST_S with the longest way; None for a record that is no longer."""
    t = (samples.t_us - samples.t_us[0]) * 1e-6
    if t[-1] <= MOST_S:
        return None
    way = _way(t, x)
    last = len(way) - int(MOST_S) - 1
    start = float(np.argmax(way[int(MOST_S) :][: last + 1] - way[: last + 1]))
    return start, start + MOST_S


def _way(t_s: FloatArray, x: FloatArray) -> FloatArray:
    """The way, in the unit of x, up to each whole second of positions x (n,) at t_s (n,) from 0.

    Between means over STROKE_S: of one sample a second a motion of 1 Hz is none, and of 600 s the
    120 s of rest were looked at.
    """
    last = int(min(t_s[-1], LONGEST_S))
    known = t_s <= LONGEST_S
    t_s, x = t_s[known], x[known]
    first = np.flatnonzero(np.diff(np.floor(t_s / STROKE_S), prepend=-1.0))
    mean = np.add.reduceat(x, first) / np.diff(first, append=len(x))
    second = t_s[first[1:]].astype(np.int64)
    per_second = np.bincount(second, np.abs(np.diff(mean)), minlength=last)
    return np.append(0.0, np.cumsum(per_second))[: last + 1]
