"""The last second of every signal in tenths, smallest and largest value: what a live page draws.

The loop leaves the rows that it hands over anyway; who tells the status takes them once a second.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from rtid.daemon.status import Scope
from rtid.plain import FloatArray

BINS_PER_S = 10
MOST_CHUNKS = 30  # of a teller that does not come
DIGITS = 5


class ScopeKeeper:
    """Takes chunks (n, 2 + signals), SI, of the loop's thread, and gives them up to another."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._chunks: deque[FloatArray] = deque(maxlen=MOST_CHUNKS)

    def add(self, chunk: FloatArray) -> None:
        """Rows (n, 2 + signals), SI, that nobody changes any more."""
        self._chunks.append(chunk)

    def take(self) -> Scope:
        """All rows since the last time, in tenths of a second."""
        chunks = [self._chunks.popleft() for _ in range(len(self._chunks))]
        rows = np.concatenate([c for c in chunks if len(c)] or [np.empty((0, 2))])
        if not len(rows):
            return Scope()
        number = np.floor(BINS_PER_S * rows[:, 0])
        first = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        low, high = (f.reduceat(rows[:, 2:], first, axis=0) for f in (np.minimum, np.maximum))
        t_s = tuple((number[first] / BINS_PER_S).tolist())
        return Scope(t_s, self._by_name(low), self._by_name(high))

    def _by_name(self, values: FloatArray) -> dict[str, tuple[float, ...]]:
        return {
            name: tuple(float(f"{v:.{DIGITS}g}") for v in column)
            for name, column in zip(self._names, values.T, strict=True)
        }
