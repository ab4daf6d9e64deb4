"""Which rows of two fits are of the same time of a record, and for which noise each weighs them.

Timings and lags move the working points, and what leaves the grids has no row: two fits of a record
may have other rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtid.plain import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class WeighedRows:
    """Rows of a fit, kept where all else of them is let go.

    first, last: interval of the record in which each row (rows,) begins, and ends; fresh: it has
    none before it; log_noise: logarithm of the determinant of the noise that it is weighed for,
    2 ln m3 per chamber.
    """

    first: NDArray[np.int32]
    last: NDArray[np.int32]
    fresh: BoolArray
    log_noise: FloatArray

    def paired(self, other: WeighedRows) -> tuple[IntArray, IntArray]:
        """Numbers (pairs,) of its rows, and of another fit's, that are of the same time.

        Of half of their intervals at least: behind what left the grids of one alone, its rows begin
        at other samples than the other one's.  One that is fresh knows nothing of a row before it,
        and is none that is not.
        """
        theirs = np.searchsorted(other.first, (self.first + self.last) // 2, side="right") - 1
        at = np.flatnonzero(np.diff(theirs, prepend=-1) > 0)
        theirs = theirs[at]
        first, last = self.first[at], self.last[at]
        begun, end = other.first[theirs], other.last[theirs]
        shared = 1 + np.minimum(last, end) - np.maximum(first, begun)
        alike = 2 * shared > np.maximum(last - first, end - begun)
        alike &= self.fresh[at] == other.fresh[theirs]
        return at[alike], theirs[alike]

    def noisier_than(self, other: WeighedRows) -> float:
        """What ln det of the noise is more by than another fit's, of the rows of the same time."""
        at, theirs = self.paired(other)
        return float((self.log_noise[at] - other.log_noise[theirs]).sum())
