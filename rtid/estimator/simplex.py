"""The smallest value of a function of few numbers, within bounds, from its values alone.

A simplex of n + 1 points walks downhill: its worst point is mirrored in the middle of the others,
farther where that is the best so far, nearer where it is still the worst; where none of it helps,
all points halve their way to the best one.

Source: Nelder, Mead 1965, A simplex method for function minimization; the steps and their order are
those of scipy.optimize.minimize (tests hold it against that), which takes as long to import as an
edge takes here, at each start.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rtid.plain import FloatArray

MOST_VALUES = 200  # of the function, per unknown
NEAR, NO_MORE = 0.05, 0.05  # the points and their values are so close together: done


class Lowest(NamedTuple):
    """Where the function is smallest (n,), and its value there."""

    x: FloatArray
    value: float


def lowest(
    function: Callable[[FloatArray], float],
    start: FloatArray,
    bounds: Sequence[tuple[float, float]],
) -> Lowest:
    """Walk from a simplex `start` (n + 1, n), in any units, its first point within bounds (n,)."""
    walk = _Walk(function, start, np.array(bounds))
    most = MOST_VALUES * start.shape[1]
    while walk.calls < most and not walk.is_there():
        walk.step()
    return Lowest(walk.points[0], float(walk.values[0]))


class _Walk:
    """The simplex, its points (n + 1, n) from best to worst with their values (n + 1,)."""

    def __init__(
        self, function: Callable[[FloatArray], float], start: FloatArray, bounds: FloatArray
    ) -> None:
        self.function, self.low, self.high, self.calls = function, bounds[:, 0], bounds[:, 1], 0
        mirrored = np.where(start > self.high, 2.0 * self.high - start, start)
        self.points = np.clip(mirrored, self.low, self.high)
        self.values = np.array([self._value(point) for point in self.points])
        self._sort()

    def is_there(self) -> bool:
        """Whether the points and their values lie close together."""
        wide = np.abs(self.points[1:] - self.points[0]).max()
        return bool(wide <= NEAR and np.abs(self.values[0] - self.values[1:]).max() <= NO_MORE)

    def step(self) -> None:
        """Replace the worst point, or draw all points to the best."""
        middle, worst = self.points[:-1].sum(0) / len(self.low), self.points[-1]
        at, value = self._tried(2.0 * middle - worst)
        if value < self.values[0]:
            farther, lower = self._tried(3.0 * middle - 2.0 * worst)
            self._replace(*((farther, lower) if lower < value else (at, value)))
        elif value < self.values[-2]:
            self._replace(at, value)
        elif value < self.values[-1]:
            nearer, lower = self._tried(1.5 * middle - 0.5 * worst)
            self._replace(nearer, lower) if lower <= value else self._shrink()
        else:
            inside, lower = self._tried(0.5 * middle + 0.5 * worst)
            self._replace(inside, lower) if lower < self.values[-1] else self._shrink()
        self._sort()

    def _tried(self, point: FloatArray) -> tuple[FloatArray, float]:
        """The point within the bounds, and the value there."""
        within = np.clip(point, self.low, self.high)
        return within, self._value(within)

    def _value(self, point: FloatArray) -> float:
        self.calls += 1
        return self.function(point)

    def _replace(self, point: FloatArray, value: float) -> None:
        self.points[-1], self.values[-1] = point, value

    def _shrink(self) -> None:
        best = self.points[0].copy()
        for k in range(1, len(self.points)):
            self.points[k], self.values[k] = self._tried(best + 0.5 * (self.points[k] - best))

    def _sort(self) -> None:
        order = np.argsort(self.values)
        self.points, self.values = self.points[order], self.values[order]
