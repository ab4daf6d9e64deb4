"""Slow pressure sensors, and a position that comes late."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rtid.effects.column import Cause, fixed, of_page
from rtid.effects.law import Volumes
from rtid.effects.laws.common import slope_to, stored
from rtid.effects.page import Effect
from rtid.effects.record_view import RecordView


def late_pressure(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """A slow pressure sensor on each chamber."""
    for c, chamber in enumerate(view.model.chambers):
        yield fixed(of_page(effect, chamber.name), _slow_pressure, view, c)


def late_position(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """A position that comes late."""
    yield fixed(of_page(effect, view.model.position), _late_position, view)


def _slow_pressure(view: RecordView, c: int) -> Volumes:
    """The true pressure is ahead by tau dP/dt, in the map and in what is stored."""
    rate = view.smooth(view.pressure(c), 1)
    through = 0.5 * (rate[1:] + rate[:-1]) * slope_to(view, c) * view.dt_s
    return {c: through + view.compliance[c] * stored(view, c, rate)}


def _late_position(view: RecordView) -> Volumes:
    """A delay takes from the position what was gained within it: the flow before the delay."""
    late = {}
    for c in range(len(view.model.chambers)):
        rate = view.smooth(view.pressure(c), 1)[:-1]
        swept = view.chamber_flow(c) - view.compliance[c] * view.volume(c)[:-1] * rate
        late[c] = -np.diff(swept, prepend=swept[:1])
    return late
