"""Samples: the only thing that the estimator may see of a machine.

A sample is complete or does not exist: at time t_us[k] every signal has a value in SI units,
commands as held from t_us[k] on, sensors as measured at (or interpolated to) t_us[k].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ROW = 1  # the position was measured at this instant (not interpolated): it yields a row
GAP = 2  # continuity with the previous sample is broken: integrals and filters restart


@dataclass(frozen=True)
class Samples:
    """A run of n samples of m signals.

    t_us: int64 (n,), strictly increasing, microseconds; values: float64 (n, m), SI units, columns
    as in `names`; flags: uint8 (n,), a combination of ROW and GAP.
    """

    names: tuple[str, ...]
    t_us: NDArray[np.int64]
    values: NDArray[np.float64]
    flags: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.t_us)

    def column(self, name: str) -> NDArray[np.float64]:
        """Values of one signal, float64 (n,), SI units."""
        return self.values[:, self.names.index(name)]

    def between(self, start_s: float, stop_s: float) -> Samples:
        """The samples with start_s <= t < stop_s, t counted from the first sample."""
        t = (self.t_us - self.t_us[0]) * 1e-6 if len(self) else self.t_us
        keep = (t >= start_s) & (t < stop_s)
        return Samples(self.names, self.t_us[keep], self.values[keep], self.flags[keep])


def join(parts: Sequence[Samples]) -> Samples:
    """Runs of samples of the same signals, one after the other."""
    return Samples(
        parts[0].names,
        np.concatenate([p.t_us for p in parts]),
        np.concatenate([p.values for p in parts]),
        np.concatenate([p.flags for p in parts]),
    )
