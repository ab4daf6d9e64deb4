"""A rate that is measured itself: its running sum is the position of the plant's equation.

    y = f(u)  is  dX/dt = f(u),   X_k+1 = X_k + (y_k + y_k+1) / 2 * dt

Behind a lag, y + tau dy/dt = f(u), it is X + tau y whose rate the maps give.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.model import OTHER, Signal
from rtid.plain import FloatArray

STILL = 1e-6  # of the rated size, times a second: noise of the integral beside that of what it sums


@dataclass(frozen=True)
class RunningSum:
    """The running integral of one signal, with what a lag behind the maps adds to it.

    column: of the signal among the model's; rated: usual size of the maps, SI.
    """

    of: Signal
    column: int
    rated: float
    behind_s: float = 0.0

    @property
    def signal(self) -> Signal:
        """The integral as a signal."""
        return sum_signal(self.of, self.rated)

    @property
    def key(self) -> tuple[object, ...]:
        """What makes it one of a kind."""
        return self.signal.name, self.behind_s

    def volumes(self, chunk: FloatArray) -> FloatArray:
        """What each interval of a record adds (n - 1,); nothing where it is not finite.

        chunk (n, 2 + signals), SI; a value beyond its range counts as its limit.
        """
        y = np.clip(chunk[:, 2 + self.column], self.of.minimum, self.of.maximum)
        added = 0.5 * (y[1:] + y[:-1]) * np.diff(chunk[:, 0]) + self.behind_s * np.diff(y)
        return np.where(np.isfinite(added), added, 0.0)


def sum_signal(of: Signal, rated: float) -> Signal:
    """The running integral of a signal as a signal; rated: usual size of the maps, SI."""
    return Signal(f"sum of {of.name}", OTHER, f"{of.unit} s", noise=STILL * rated)
