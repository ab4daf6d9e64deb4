"""Stamps that come without arrivals, as in a log: a clock that is set back must not stop them.

A frame older than the last one is refused, so after a step of -1 h nothing would be taken for an
hour.  Here such a step becomes one gap of 1 s; everything else stays as it is, to the bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Integer, kernel

BACK_US = 1_000_000  # frames out of order are not that late
GAP_US = 1_000_000  # what is put between the frames before and after a step


@kernel
def carry_on(t_us: NDArray[np.int64], state: NDArray[np.int64]) -> Integer:
    """Shift t_us so that it never goes back by a step; the steps.  Both changed in place.

    t_us (n,).  state (3,): [latest time, us; shift, us; whether it has begun].
    """
    steps = 0
    for k in range(len(t_us)):
        t = t_us[k] + state[1]
        if state[2] and t < state[0] - BACK_US:
            steps += 1
            state[1] += state[0] + GAP_US - t
            t = state[0] + GAP_US
        state[0], state[2] = (max(t, state[0]) if state[2] else t), 1
        t_us[k] = t
    return steps


class Continuous:
    """Takes the steps back out of a stream; a clock set forward is a gap by itself.

    `refused` of what `push` returns counts "clock_step".
    """

    def __init__(self) -> None:
        self._state = np.zeros(3, np.int64)

    def push(self, frames: Frames) -> Frames:
        """The same frames, their stamps changed in place."""
        fr.add_counts(frames.refused, {"clock_step": int(carry_on(frames.t_us, self._state))})
        return frames
