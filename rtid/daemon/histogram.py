"""A histogram of durations: 24 bins per decade from 1 us to 10 s, a few hundred ns per entry."""

from __future__ import annotations

from bisect import bisect_right

PER_DECADE, DECADES = 24, 7
EDGES_US: tuple[float, ...] = (
    0.0,
    *(10.0 ** (k / PER_DECADE) for k in range(PER_DECADE * DECADES + 1)),
)


class Histogram:
    """counts[k] durations in [EDGES_US[k], EDGES_US[k + 1]), the last one open."""

    def __init__(self) -> None:
        self.counts = [0] * len(EDGES_US)
        self.count, self.max_us = 0, 0.0

    def add(self, duration_us: float) -> None:
        """Count one duration; a negative one counts as 0."""
        self.counts[bisect_right(EDGES_US, max(duration_us, 0.0)) - 1] += 1
        self.count += 1
        self.max_us = max(self.max_us, duration_us)

    def quantile_us(self, share: float) -> float:
        """The duration that this share stays below: the upper edge of its bin, 10 % too much."""
        wanted, seen = share * self.count, 0
        for k, n in enumerate(self.counts):
            seen += n
            if n and seen >= wanted:
                return min(EDGES_US[k + 1] if k + 1 < len(EDGES_US) else self.max_us, self.max_us)
        return 0.0
