"""The fewest nodes along one axis of a table: each as far from the one before as chords allow.

A chord from a node at x_0 to one at x_t misses no point between by more than e where its slope is

    max over i of (f_i - f_0 - e) / (x_i - x_0)  <=  (f_t - f_0) / (x_t - x_0)  <=  min of (.. + e),

so that one walk outwards, with the largest lower and the least upper bound of every column so far,
tells the last node to which all columns are followed (the swinging door of Bristol 1990).
"""

from __future__ import annotations

import numpy as np

from rtid.kernels.jit import kernel, part
from rtid.plain import FloatArray, IntArray


@kernel
def far_apart(x: FloatArray, exact: FloatArray, allowed: float, fine: int, at: IntArray) -> int:
    """Indices of nodes among x (n,), into at (n,); how many they are.

    Every fine-th is one; between them exact (n, m) is linear to `allowed`, in its unit.
    """
    low, high = np.empty(exact.shape[1]), np.empty(exact.shape[1])
    at[0], count = 0, 1
    for end in range(fine, len(x), fine):
        while at[count - 1] < end:
            at[count] = _farthest(x, exact, allowed, at[count - 1], end, low, high)
            count += 1
    return count


@part
def _farthest(
    x: FloatArray,
    exact: FloatArray,
    allowed: float,
    start: int,
    end: int,
    low: FloatArray,
    high: FloatArray,
) -> int:
    """The last index up to `end` to which a chord from `start` misses nothing by more."""
    low[:], high[:] = -np.inf, np.inf
    good = start + 1
    for t in range(start + 1, end + 1):
        run, fits, is_open = x[t] - x[start], True, True
        for j in range(len(low)):
            slope = (exact[t, j] - exact[start, j]) / run
            fits = fits and low[j] <= slope <= high[j]
            low[j] = max(low[j], slope - allowed / run)
            high[j] = min(high[j], slope + allowed / run)
            is_open = is_open and low[j] <= high[j]
        if fits:
            good = t
        if not is_open:
            break
    return good
