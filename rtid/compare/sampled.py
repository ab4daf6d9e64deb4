"""What is left of a rate that is measured itself, sample by sample, without any filter.

    left_k = y_k - (what the maps and effects give over [t_k, t_k+1], behind the lag)

While a command is given: a machine that stands on its floor, or hits it, tells nothing of its maps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.compare.comparison import Comparison
from rtid.effects.laws.drift import any_given
from rtid.model import Machine


@dataclass(frozen=True)
class SampleErrors:
    """Over the samples while a command is given, or at rest: s; mean and standard deviation, SI."""

    given: bool
    duration_s: float
    mean: float
    sd: float

    @property
    def rms(self) -> float:
        """Root mean square, SI."""
        return float(np.hypot(self.mean, self.sd))


def sample_errors(model: Machine, part: Comparison) -> tuple[SampleErrors, ...]:
    """What a part leaves of a rate that is measured itself; () of other plants."""
    inner = part.intervals
    if not len(inner.left):
        return ()
    commands = dict.fromkeys(edge.command for edge in model.edges)
    given = any_given([inner.values[:, model.column(name)] for name in commands])
    steps, known = np.diff(inner.t_s), np.isfinite(inner.left)
    errors = []
    for state in (True, False):
        here = known & (given == state)
        if here.any():
            left, duration_s = inner.left[here], float(steps[here].sum())
            errors.append(SampleErrors(state, duration_s, float(left.mean()), float(left.std())))
    return tuple(errors)
