"""A sensor that freezes while its alive counter runs: its value repeats as noise never would.

Of two readings of a steady quantity with noise sd s, in steps q, at most the share
p = q / (2 sqrt(pi) s) are equal.  Where s >= q / 2, a run of n equal readings with p^n < 1e-12,
three times over, is no chance; a sensor without such noise may stand still and is not judged here.
Samples are refused from there until the value moves again.  No clock is asked.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.jit import Records, kernel
from firmware_bridge.samples import GAP, Samples

CHANCE, SAFETY = 1e-12, 3
LEAST_RUN = 20
REASON = "frozen"

SIGNAL = np.dtype(
    [
        ("limit", np.int64),  # equal readings that are no chance; 0: never judged
        ("repeats", np.int64),
        ("value", np.float64),
        ("minimum", np.float64),  # since somebody set them
        ("maximum", np.float64),
    ]
)
EXTREMES = (("minimum", np.inf), ("maximum", -np.inf))


def run_limit(noise: float, resolution: float, sources: int = 1) -> int:
    """Equal readings in a row that are no chance; 0 where noise does not tell.

    sources: how many messages make samples, each of which repeats the others' readings.
    """
    if noise <= 0 or noise < resolution / 2:
        return 0
    share = resolution / (2 * math.sqrt(math.pi) * noise)
    run = math.log(CHANCE) / math.log(share) if share > 0 else 1.0
    return max(LEAST_RUN, math.ceil(SAFETY * run)) * sources


@kernel
def judge(
    signals: Records,
    state: NDArray[np.int64],
    values: NDArray[np.float64],
    flags: NDArray[np.uint8],
    keep: NDArray[np.bool_],
) -> int:
    """Set keep (n,) to False where any signal is frozen, GAP behind; how many are refused.

    signals (m,) and state (1,): whether samples are being refused, changed in place with flags.
    """
    refused = 0
    for k in range(len(values)):
        frozen = False
        for j in range(len(signals)):
            signal, value = signals[j], values[k, j]
            signal.repeats = signal.repeats + 1 if value == signal.value else 0
            signal.value = value
            signal.minimum, signal.maximum = min(signal.minimum, value), max(signal.maximum, value)
            frozen = frozen or (signal.limit > 0 and signal.repeats >= signal.limit)
        if frozen:
            keep[k] = False
            refused += 1
        elif state[0]:
            flags[k] |= GAP
        state[0] = frozen
    return refused


class Frozen:
    """Refuses samples while a sensor is frozen; limits (m,): `run_limit` of each signal."""

    def __init__(self, limits: list[int]) -> None:
        self.signals = np.zeros(len(limits), SIGNAL)
        self.signals["limit"] = limits
        self.signals["value"] = np.nan
        self._state = np.zeros(1, np.int64)
        self.refused = 0
        self.reset_extremes()

    def push(self, samples: Samples) -> Samples:
        """The samples that may be believed."""
        keep = np.ones(len(samples), np.bool_)
        refused = judge(self.signals, self._state, samples.values, samples.flags, keep)
        if not refused:
            return samples
        self.refused += refused
        t_us, values, flags = samples.t_us[keep], samples.values[keep], samples.flags[keep]
        return replace(samples, t_us=t_us, values=values, flags=flags)

    def reset_extremes(self) -> None:
        """Begin anew to look for the least and the largest value."""
        for name, start in EXTREMES:
            self.signals[name] = start

    @property
    def doubted(self) -> NDArray[np.bool_]:
        """Which signals are frozen now, bool (m,)."""
        limit = self.signals["limit"]
        return np.asarray((limit > 0) & (self.signals["repeats"] >= limit))
