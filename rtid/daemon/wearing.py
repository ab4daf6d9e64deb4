"""Slow wear of the machine that is learned: found between two publications, and carried over.

What valves and leaks let through may change by RATE of the motion's flow at most: twice 10 % in an
hour of motion, which is 10 % in 10 h of a machine that moves for 6 min of each hour.  A fault that
begins is noticed within seconds, in which this moves the map by less than a thousandth.  What has
changed by less than LEAST is left to what is learned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.estimator.solution import Solution
from rtid.estimator.sums import Sums
from rtid.estimator.wear import Wear, carried_over, changed, wear_since
from rtid.plain import FloatArray

RATE = 0.2 / 3600  # per second of motion
LEAST = 1e-3
SURE = 5.0  # standard deviations
NEWS = 20  # seconds of motion behind what is known, before a change is looked for


@dataclass(frozen=True)
class Known:
    """What was learned at one time, and the seconds of motion until then."""

    sums: Sums
    solution: Solution
    moved: int


class WearWatch:
    """Gains and leaks against those of what was learned before."""

    def __init__(self) -> None:
        self._before: Known | None = None

    def forget(self) -> None:
        """Begin anew: another estimate is gone on with."""
        self._before = None

    def push(self, total: Sums, solution: Solution, moved: int) -> Wear | None:
        """Take what is known by now, after so many seconds of motion; what is to be carried over.

        None where nothing has changed that matters, or it is not known yet.
        """
        now, before = Known(total, solution, moved), self._before
        if before is None or total.rows < before.sums.rows:
            self._before = now
            return None
        if moved < before.moved + NEWS:
            return None
        self._before = now
        wear, sd = wear_since(before.sums, before.solution, total)
        size, error = (_of_motion(part, total) for part in (wear, sd))
        if not (size > np.maximum(LEAST, SURE * error)).any():
            return None
        wear = wear.times(min(1.0, RATE * (moved - before.moved) / float(size.max())))
        self._before = Known(carried_over(total, wear), changed(solution, wear), moved)
        return wear


def _of_motion(wear: Wear, total: Sums) -> FloatArray:
    """Sizes (edges + terms,) as shares of the motion's flow."""
    squares = np.diag(total.shared)
    share = np.sqrt(squares[len(squares) - len(wear.terms) :] / squares[0])
    return np.abs(np.concatenate([wear.gain, wear.terms * share]))
