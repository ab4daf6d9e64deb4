"""The gain of maps that give what is measured drifts: y = (1 + g t) Q(u), while a command is given.

A command that rests at an end of its range gives nothing that drifts: a machine that stands on its
floor then is held by the floor, and the map tells of that at the resting command alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rtid.effects.column import Cause, of_page
from rtid.effects.law import Shape, Volumes
from rtid.effects.page import Effect
from rtid.effects.record_view import RecordView
from rtid.plain import BoolArray, FloatArray

OFTEN = 0.05  # share of the samples that a command rests at an end of its range


def gain_drift(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """What a drift of a share per second adds, beside a rate that is measured itself."""
    model = view.model
    if model.measured and len(view.along):

        def column(_: Shape) -> Volumes:
            middle = 0.5 * (view.t_s[1:] + view.t_s[:-1])
            return {0: np.where(acts(view), view.chamber_flow(0) * middle * view.dt_s, 0.0)}

        page = of_page(effect, model.measured)
        yield Cause(page, column, offered=not model.joined)


def acts(view: RecordView) -> BoolArray:
    """Intervals (n - 1,) over which some command is not at rest."""
    commands = dict.fromkeys(edge.command for edge in view.model.edges)
    moving = [_is_given(view.signal(name)[:-1]) for name in commands]
    return np.any(moving, axis=0)


def _is_given(u: FloatArray) -> BoolArray:
    """Where commands (n,) are not at an end of their range at which they often are."""
    rests = [end for end in (u.min(), u.max()) if np.mean(u == end) > OFTEN]
    return ~np.isin(u, rests)
