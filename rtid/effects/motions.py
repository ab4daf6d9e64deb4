"""Motions beside a rate that is measured itself: whose velocity tells of friction on it.

The velocity over an interval is the mean of its ends, or what a position has changed by.  Within
the noise of that it counts as rest: its sign would be the noise's.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from rtid.model import POSITION, VELOCITY, Machine
from rtid.plain import FloatArray

if TYPE_CHECKING:
    from rtid.effects.record_view import RecordView

RATE = "rate of "  # before a motion's name in an equation: its velocity over an interval
RESTING_SD = 3.0  # of the noise of a velocity: less is rest
KINDS = (POSITION, VELOCITY)


def halves_of(model: Machine) -> set[str]:
    """The signals that a diagnosis has split others into, by their sign: "u+" and "u-"."""
    names = {signal.name for signal in model.signals}
    return {name for name in names if name[-1] in "+-" and name[:-1] in names}


def motions(model: Machine) -> tuple[str, ...]:
    """The signals that tell of a motion beside a rate that is measured itself.

    What a map is over is none: a function of that velocity is the map's.
    """
    halves = halves_of(model)
    taken = {name for edge in model.edges for name in (edge.command, edge.source)}
    taken |= halves | {name[:-1] for name in taken & halves}
    moving = (s.name for s in model.signals if s.kind in KINDS and s.name not in taken)
    return tuple(moving) if model.measured else ()


def rates(model: Machine) -> set[str]:
    """The names in an equation that stand for the velocity of a signal."""
    return {RATE + s.name for s in model.signals if s.kind in KINDS}


def velocity(view: RecordView, rate: str) -> FloatArray:
    """Mean velocity over each interval (n - 1,) by its name in an equation, SI; 0 at rest."""
    name = rate.removeprefix(RATE)
    signal, values = view.model.signals[view.model.column(name)], view.signal(name)
    if signal.kind == VELOCITY:
        mean = 0.5 * (values[1:] + values[:-1])
        limit = np.full(len(mean), signal.noise * math.sqrt(0.5))
    else:
        mean = np.diff(values) / view.dt_s
        limit = signal.noise * math.sqrt(2.0) / view.dt_s
    return np.where(np.abs(mean) > RESTING_SD * limit, mean, 0.0)
