"""Lines of a record at any zoom: the least and the largest value of every bin are always drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from tsdownsample import MinMaxDownsampler

from rtid.model import FloatArray

POINTS = 1200  # that a line has at most: two per pixel of a plot
MOST_GAPS = 400
_THIN: Any = MinMaxDownsampler()  # type: ignore[no-untyped-call]


@dataclass(frozen=True)
class Line:
    """y (n,) over rising t (n,); NaN where the line is broken."""

    t: FloatArray
    y: FloatArray

    @classmethod
    def joined(cls, parts: list[tuple[FloatArray, FloatArray]]) -> Line:
        """Parts one after the other, the line broken between them and at gaps of their times."""
        t_all, y_all = [np.empty(0)], [np.empty(0)]
        for t, y in parts:
            if len(t):
                at = _gaps(t)
                t_all += [np.insert(t, at, t[at - 1]), t[-1:]]
                y_all += [np.insert(y, at, np.nan), np.array([np.nan])]
        return cls(np.concatenate(t_all), np.concatenate(y_all))

    def between(self, low: float, high: float, points: int = POINTS) -> tuple[FloatArray, ...]:
        """What is seen of it from low to high, one sample beyond at either end."""
        first = max(0, int(np.searchsorted(self.t, low)) - 1)
        last = min(len(self.t), int(np.searchsorted(self.t, high, side="right")) + 1)
        t, y = self.t[first:last], self.y[first:last]
        if len(y) <= points:
            return t, y
        known = np.isfinite(y)
        chosen = _THIN.downsample(_held(y, known), n_out=points).astype(int)
        chosen = np.union1d(chosen, [0, len(y) - 1])
        breaks = np.flatnonzero(known[:-1] & ~known[1:])
        if len(breaks) <= MOST_GAPS:
            ends = np.flatnonzero(~known[:-1] & known[1:])
            chosen = np.union1d(chosen, np.concatenate([breaks, breaks + 1, ends, ends + 1]))
        return t[chosen], y[chosen]


def _held(y: FloatArray, known: np.ndarray) -> FloatArray:
    """y with the last known value where there is none."""
    if known.all():
        return np.ascontiguousarray(y)
    at = np.maximum.accumulate(np.where(known, np.arange(len(y)), 0))
    return np.ascontiguousarray(np.nan_to_num(y[at]))


def _gaps(t: FloatArray) -> np.ndarray:
    """Where a step is more than five usual ones."""
    if len(t) < 3:
        return np.empty(0, int)
    step = np.diff(t)
    return np.flatnonzero(step > 5 * np.median(step)) + 1
