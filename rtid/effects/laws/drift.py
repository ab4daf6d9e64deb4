"""The gain of maps that give what is measured drifts: y = (1 + g t) Q(u), while a command is given.

A command that rests at an end of its range gives nothing that drifts: a machine that stands on its
floor then is held by the floor, and the map tells of that at the resting command alone.

How the gain goes on behind the record that has told of it nobody knows: what is expected of a gain
that walks is that it stays where it was last, and t ends there.  (A flight's gain had lost 10 % in
its first half and 3 % in its second: the same line on took 6 % too much off.)
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
    if model.measured and view.beside is not None:

        def column(_: Shape) -> Volumes:
            seen_s = (view.taught or view).t_s
            middle = np.clip(0.5 * (view.t_s[1:] + view.t_s[:-1]), seen_s[0], seen_s[-1])
            return {0: np.where(acts(view), view.chamber_flow(0) * middle * view.dt_s, 0.0)}

        page = of_page(effect, model.measured)
        yield Cause(page, column, offered=not model.joined)


def acts(view: RecordView) -> BoolArray:
    """Intervals (n - 1,) over which some command is not at rest."""
    commands = dict.fromkeys(edge.command for edge in view.model.edges)
    return any_given([view.signal(name)[:-1] for name in commands])


def any_given(commands: list[FloatArray]) -> BoolArray:
    """Where some of the commands, each (n,) in its unit, are not at rest: see above."""
    return np.any([_is_given(u) for u in commands], axis=0)


def _is_given(u: FloatArray) -> BoolArray:
    """Where a command (n,) is not at an end of its range at which it often is."""
    rests = [end for end in (u.min(), u.max()) if np.mean(u == end) > OFTEN]
    return ~np.isin(u, rests)
