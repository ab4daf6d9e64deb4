"""Valves that change with time, slow pressure sensors, and a position that comes late."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rtid.diagnose.candidates import (
    Candidate,
    Cause,
    Volumes,
    fixed,
)
from rtid.diagnose.causes.common import slope_to, stored
from rtid.diagnose.view import View


def drift(view: View) -> Iterator[Cause]:
    """All valves give more, or less, as time goes on: relative change per second."""

    def make() -> Volumes:
        t = view.t_s[1:]  # of the whole trace, or the held-out part would begin anew
        n_c = len(view.model.chambers)
        return {c: view.chamber_flow(c) * t * view.dt_s for c in range(n_c)}

    yield fixed(
        Candidate("valve_gain_drift", "all valves", "relative_change", "1", 1.0, sign=0), make
    )


def sensors(view: View) -> Iterator[Cause]:
    """Slow pressure sensors, and a position that comes late."""
    for c, chamber in enumerate(view.model.chambers):
        yield fixed(
            Candidate("pressure_sensor_lag", chamber.name, "time_constant", "s", 0.2),
            _slow_pressure, view, c,
        )  # fmt: skip
    yield fixed(
        Candidate("position_sensor_delay", view.model.position, "delay", "s", 0.2),
        _late_position, view,
    )  # fmt: skip


def _slow_pressure(view: View, c: int) -> Volumes:
    """The true pressure is ahead by tau dP/dt, in the map and in what is stored."""
    rate = view.smooth(view.pressure(c), 1)
    through = 0.5 * (rate[1:] + rate[:-1]) * slope_to(view, c) * view.dt_s
    return {c: through + view.compliance[c] * stored(view, c, rate)}


def _late_position(view: View) -> Volumes:
    """A delay takes from the position what was gained within it: the flow before the delay."""
    late = {}
    for c in range(len(view.model.chambers)):
        rate = view.smooth(view.pressure(c), 1)[:-1]
        swept = view.chamber_flow(c) - view.compliance[c] * view.volume(c)[:-1] * rate
        late[c] = -np.diff(swept, prepend=swept[:1])
    return late
