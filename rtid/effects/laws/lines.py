"""The line between valve and chamber as a whole: its oil's inertia, volume and resistance.

One pi section: half of the line's volume V_l at the valve, half beside the chamber, C = V_l / beta,

    C dp_v/dt = Q(u, p_v) - q,    I dq/dt = p_v - p_c - R q,    A v = q - (V + V_l) / beta dp_c/dt

The sensor is at either end.  With d = p_v - p_c and Q_0, k = - dQ/dp of the fitted maps at the
pressure that is measured, a sensor at the cylinder leaves to the chamber beside Q_0

    q - Q_0 - C dp_c/dt,            C dd/dt = Q_0 - k d - q - C dp_c/dt,

and one at the valve, by whose pressure the maps are right,

    (V + V_l) / beta dd/dt - 2 C dp_v/dt,       d = I dq/dt + R q,  q = Q_0 - C dp_v/dt,

by parabolas: an equation for p_c would want A v, and of the measured motion it explained itself.
Its natural frequency 1 / sqrt(I C) is what a record tells first: it stands in the place of I.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from rtid.effects.column import WHOLE, Candidate, Cause
from rtid.effects.filtering import fitted
from rtid.effects.law import Shape, Volumes, chambers_by_place
from rtid.effects.laws.gauged import gauged
from rtid.effects.magnitude import volume_times
from rtid.effects.page import Effect, catalogue, correcting
from rtid.effects.record_view import RecordView
from rtid.kernels.jit import kernel
from rtid.model import Machine
from rtid.plain import FloatArray, Key

LINE = "line"  # the law's name
OF_LINES = "dead volume"  # the declared size that the oil of a line adds to
FREQUENCY = "natural_frequency"
AT_VALVE, AT_CYLINDER = (f"{FREQUENCY}_sensor_at_{end}" for end in ("valve", "cylinder"))
# to begin with: natural frequencies of 12 to 2 m of hose, volumes, and the loss of laminar flow;
# the last two of a usual machine: a larger one has thicker lines, which lose less
RADPS, VOLUMES_M3, RESISTANCES = (130.0, 200.0, 300.0, 450.0, 700.0), (2e-4, 6e-4), (2e8, 2e9)
LARGEST = 3.0  # times the bank's own size that a column of it may have
QUICK_S = 2e-3  # half width of the parabolas
SWING = 0.5 * np.pi  # of a line's phase between two samples, beyond which nobody sees it ring
DOUBLINGS = 2  # of a step of the section's equations until it is an interval of the record


def lines(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """A line before one chamber or alike before both, seen by sensors at either end of it.

    Of those whose ringing the record samples; none where it is too slow for any.
    """
    known = {p.name: p for p in effect.parameters}
    radps = tuple(w for w in RADPS if is_sampled(w, view))
    if not radps:
        return
    for place, at in chambers_by_place(view.model).items():
        for name, column in ((AT_VALVE, _at_valve), (AT_CYLINDER, _at_cylinder)):
            candidate = Candidate(
                effect.name, place, WHOLE, "1", LARGEST, 1,
                shape_names=(name, "volume", "resistance"),
                shape_units=tuple(known[n].unit for n in (FREQUENCY, "volume", "resistance")),
                page=effect,
            )  # fmt: skip
            axes = radps, *_sizes(view.model)
            yield Cause(candidate, partial(_of_chambers, column, view, at), axes)


def _sizes(model: Machine) -> tuple[Shape, Shape]:
    """Volumes, m3, and resistances, Pa s/m3, of the lines of a machine to begin with."""
    times = max(1.0, volume_times(model))
    return tuple(times * v for v in VOLUMES_M3), tuple(r / times for r in RESISTANCES)


def is_sampled(radps: float, view: RecordView) -> bool:
    """Whether a record has samples close enough for what rings at radps, rad/s."""
    return bool(radps * np.median(view.dt_s) < SWING)


def lines_at(where: str) -> set[Key]:
    """The effects of the catalogue that are a line at a place."""
    return {(page.name, where) for page in catalogue().values() if page.law == LINE}


def stores_at(where: str) -> set[Key]:
    """What a line stores at a place, each by itself: its oil, and its wall."""
    return {(page.name, where) for page in correcting(OF_LINES)}


def _of_chambers(
    column: Callable[[RecordView, int, Shape], FloatArray],
    view: RecordView,
    at: tuple[int, ...],
    shape: Shape,
) -> Volumes:
    return {c: column(view, c, shape) for c in at}


def inertance(view: RecordView, candidate: Candidate) -> float:
    """I of a line of this shape, Pa s2/m3."""
    at = list(chambers_by_place(view.model)[candidate.where])
    soft = candidate.shape[1] * float(np.mean(view.compliance[at]))
    return 1.0 / (soft * candidate.shape[0] ** 2)


def line_softness(view: RecordView, candidate: Candidate) -> Volumes:
    """What the oil of a line takes up per Pa of the measured pressure (n,), m3/Pa."""
    at, volume = chambers_by_place(view.model)[candidate.where], candidate.shape[1]
    return {c: np.full(view.n, 2.0 * volume * float(view.compliance[c])) for c in at}


def line_echo(view: RecordView, candidate: Candidate, noise: Volumes) -> Volumes:
    """What a line makes of its pressure's noise alone, chamber -> (n,) Pa."""
    of_noise = _late if AT_CYLINDER in candidate.shape_names else _kept_back
    at, nothing = chambers_by_place(view.model)[candidate.where], np.zeros(view.n - 1)
    return {c: of_noise(view, c, candidate.shape, noise[c], nothing) for c in at}


def _at_cylinder(view: RecordView, c: int, shape: Shape) -> FloatArray:
    """What the line takes from the flow of the valves by the time it reaches the chamber."""
    return _late(view, c, shape, view.pressure(c), gauged(view, c)[0])


def _late(
    view: RecordView, c: int, shape: Shape, pressure: FloatArray, flow: FloatArray
) -> FloatArray:
    """Volumes (n - 1,), m3, of q - Q_0 - C dp_c/dt for p_c (n,) and Q_0 (n - 1,)."""
    soft, resistance = shape[1] * float(view.compliance[c]), shape[2]
    through = np.empty(view.n - 1)
    drive, (_, opens) = flow - soft * np.diff(pressure) / view.dt_s, gauged(view, c)
    _section(drive, opens, view.dt_s, 1.0 / (soft * shape[0] ** 2), soft, resistance, through)
    return np.asarray((through - flow) * view.dt_s - soft * np.diff(pressure))


def _at_valve(view: RecordView, c: int, shape: Shape) -> FloatArray:
    """What the chamber stores otherwise than the pressure at the valve says."""
    return _kept_back(view, c, shape, view.pressure(c), gauged(view, c)[0])


def _kept_back(
    view: RecordView, c: int, shape: Shape, pressure: FloatArray, flow: FloatArray
) -> FloatArray:
    """Volumes (n - 1,), m3, of (V + V_l) / beta dd/dt - 2 C dp_v/dt for p_v (n,), Q_0 (n - 1,)."""
    radps, volume, resistance = shape
    soft, half = volume * float(view.compliance[c]), max(2, round(QUICK_S / view.step_s))
    at_samples = np.concatenate([flow[:1], _mean(flow), flow[-1:]])

    def along(derivative: int) -> FloatArray:
        """A derivative of q (n,)."""
        drawn = fitted(pressure, half, derivative + 1, view.step_s)
        return fitted(at_samples, half, derivative, view.step_s) - soft * drawn

    drop = along(1) / (soft * radps**2) + resistance * along(0)
    return np.asarray(_room(view, c, shape) * np.diff(drop) - 2.0 * soft * np.diff(pressure))


def _room(view: RecordView, c: int, shape: Shape) -> FloatArray:
    """(V + V_l) / beta (n - 1,), m3/Pa."""
    return (_mean(view.volume(c)) + shape[1]) * float(view.compliance[c])


def _mean(values: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (values[1:] + values[:-1]))


@kernel
def _section(
    drive: FloatArray,
    opens: FloatArray,
    dt_s: FloatArray,
    inertance: float,
    soft: float,
    resistance: float,
    through: FloatArray,
) -> None:
    """Fill through (n - 1,), m3/s: the mean of q over each interval.

    C dd/dt = drive - opens d - q,  I dq/dt = d - R q:  drive m3/s, opens m3/s/Pa, both (n - 1,).
    A step of the trapezoidal rule is q, d -> M (q, d) + v, and what q adds up to over it is
    r (q, d) + s; two of them in a row are such a step again.
    """
    q, d, steps = drive[0], resistance * drive[0], 2**DOUBLINGS
    half_a, half_b = 0.5 / (steps * inertance), 0.5 / (steps * soft)
    for k in range(len(drive)):
        a, b = half_a * dt_s[k], half_b * dt_s[k]
        left, right = 1.0 + a * resistance, 1.0 + b * opens[k]
        share = 1.0 / (left * right + a * b)
        m00, m01 = (right * (2.0 - left) - a * b) * share, 2.0 * a * share
        m10, m11 = -2.0 * b * share, (left * (2.0 - right) - a * b) * share
        v0, v1 = a * 2.0 * b * drive[k] * share, left * 2.0 * b * drive[k] * share
        r0, r1, s = 0.5 * (1.0 + m00), 0.5 * m01, 0.5 * v0
        for _ in range(DOUBLINGS):
            s += s + r0 * v0 + r1 * v1
            r0, r1 = r0 + r0 * m00 + r1 * m10, r1 + r0 * m01 + r1 * m11
            v0, v1 = v0 + m00 * v0 + m01 * v1, v1 + m10 * v0 + m11 * v1
            both, cross = m00 + m11, m01 * m10
            m00, m01, m10, m11 = m00 * m00 + cross, m01 * both, m10 * both, m11 * m11 + cross
        through[k] = (r0 * q + r1 * d + s) / steps
        q, d = m00 * q + m01 * d + v0, m10 * q + m11 * d + v1
