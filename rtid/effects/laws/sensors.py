"""Sensors that come late, put right in the record: exact, as delays of a command are.

    x(t) = x_meas(t + T),        P(t) = P_meas(t) + tau dP_meas/dt

The columns are the derivatives: what a unit more of T or tau would change, to first order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rtid.effects.column import Cause, fixed, of_page
from rtid.effects.filtering import fitted
from rtid.effects.law import Volumes, chambers_by_place
from rtid.effects.laws.common import slope_to, stored
from rtid.effects.laws.response import MAP_LAG, later, map_lag_of
from rtid.effects.laws.timing import Psi, TimingLaw, of_law
from rtid.effects.page import Effect
from rtid.effects.record_view import RecordView
from rtid.model import Machine
from rtid.plain import FloatArray

TAPS = 24  # of an allpass: what is cut off is 3e-12
ENDS = 10  # samples that tell how a signal goes on beyond its ends
PISTON_S = 5e-3  # half width of the window for a piston's rate: both are as long as a row
QUIET = 0.5  # of a pressure's noise, that its rate may add to it once tau is put right


def late_pressure(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """A slow pressure sensor on each chamber, or the same on both: one amplifier, one filter."""
    for place, at in chambers_by_place(view.model).items():
        yield fixed(of_page(effect, place), _slow_pressures, view, at)


def late_position(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """A position that comes late."""
    yield fixed(of_page(effect, view.model.position), _late_position, view)


def _slow_pressures(view: RecordView, at: tuple[int, ...]) -> Volumes:
    return {c: _slow_pressure(view, c) for c in at}


def _slow_pressure(view: RecordView, c: int) -> FloatArray:
    """The true pressure is ahead by tau dP/dt, in the map and in what is stored."""
    rate = view.smooth(view.pressure(c), 1)
    through = 0.5 * (rate[1:] + rate[:-1]) * slope_to(view, c) * view.dt_s
    return np.asarray(through + view.compliance[c] * stored(view, c, rate))


def _late_position(view: RecordView) -> Volumes:
    """A delay takes from the position what was gained within it: what is swept before it.

    The piston's rate is that of all that enters and is not stored, smoothed as one: flows that jump
    beside pressures' rates over 40 ms are none that a mass follows.  With the lag as much less,
    which moves the pressures alone, such columns told half of the slope of chi2.
    """
    late = {}
    for c in range(len(view.model.chambers)):
        kept = -view.compliance[c] * stored(view, c, view.pressure(c))
        swept = np.append(0.0, np.cumsum(view.chamber_flow(c) * view.dt_s - kept))
        late[c] = -np.diff(fitted(swept, max(2, round(PISTON_S / view.step_s)), 1, view.step_s))
    return late


def ahead(values: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """What a sensor that is psi late would have shown (n,), any unit.

    A number of samples earlier, and a part of one later by Thiran's allpass of first order,

        y_k = a x_k + x_k-1 - a y_k-1,    a = (1 - d) / (1 + d),    0.5 <= d < 1.5,

    which is a delay of d samples to what is slow, and leaves white noise as white and as large;
    before its first and behind its last value it goes on as it begins and ends.  On the line
    between two samples noise would be less, by half in their middle: of a command that came 5 ms
    late in a log of 200 Hz the position was named, late by 7.2 ms, at 0.71 of the noise.
    """
    steps = int(np.floor(psi[0] / dt_s + 1.5))
    d = steps - psi[0] / dt_s
    a = (1.0 - d) / (1.0 + d)
    taps = np.concatenate([[a], (1.0 - a * a) * (-a) ** np.arange(TAPS)])
    n, few = len(values), min(ENDS, len(values) - 1)
    if few < 1:
        return values
    at_start, at_end = (values[few] - values[0]) / few, (values[-1] - values[-1 - few]) / few
    before = values[0] + at_start * np.arange(-TAPS, 0)
    behind = values[-1] + at_end * np.arange(1, steps + 1)
    earlier = np.concatenate([before, values, behind])[steps:]
    return np.convolve(earlier, taps)[TAPS : TAPS + n]


def quickened(values: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """What a sensor of time constant psi has seen (n,), by the rate of a parabola, any unit.

    The parabola is the shortest that adds little noise: of m samples to either side tau over the
    step and the root of m (m + 1) (2 m + 1) / 3.  Over 5 ms it smoothed what 1.08 ms let through,
    found 1.15, and left a dead volume of 0.07 L.
    """
    half = max(1, math.ceil((1.5 * (psi[0] / (QUIET * dt_s)) ** 2) ** (1 / 3)))
    if len(values) < 2 * half + 1:
        return values
    return np.asarray(values + psi[0] * fitted(values, half, 1, dt_s))


LATE_POSITION = of_law("late_position", ahead, where="")
LATE_PRESSURE = of_law("late_pressure", quickened, where="")


def sensor_timings(model: Machine) -> tuple[TimingLaw, ...]:
    """The timings of a machine's sensors, each at its place, and that of a rate that is measured.

    A plant without pressures has none: its position that is late is a command that is.
    """
    if (behind := map_lag_of(model)) is not None:
        return (behind,)
    if not (model.position and model.has_pressures):
        return ()
    slow = (replace(LATE_PRESSURE, where=place) for place in chambers_by_place(model))
    return replace(LATE_POSITION, where=model.position), *slow


def sensors_of(model: Machine, timing: TimingLaw) -> tuple[str, ...]:
    """The signals that a timing of a sensor puts right."""
    chambers = chambers_by_place(model).get(timing.where)
    if chambers is None:
        return (timing.where,)
    return tuple(model.chambers[c].pressure for c in chambers)


def late(view: RecordView, timing: TimingLaw, psi: Psi) -> Volumes:
    """Volumes per interval and chamber of a unit more of what a sensor is late by."""
    if timing.effect == MAP_LAG.effect:
        return later(view, psi[0])
    chambers = chambers_by_place(view.model).get(timing.where)
    return _slow_pressures(view, chambers) if chambers else _late_position(view)
