"""Extra physics that runs by the clock: factors of the valve gains, bursts of flow.

drift   1 + g (1 - exp(-t / tau)) / (1 - exp(-T / tau)), tau = 1.5 T: a machine that warms up
swing   1 + g sin(2 pi t / 7 s)
"""

from __future__ import annotations

import numpy as np

from rtid.plain import FloatArray
from rtid.sim.extra_physics import Extra

SWING_S = 7.0
WARM_UP = 1 / 1.5  # records per time constant
BURSTS_PER_S = 0.7
BURST_S = (0.05, 0.3)  # shortest and longest
BURST_HEIGHT = (0.5, 1.5)


def schedule(e: Extra, rows: int, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """Factor of all gains and bursts in units of their size, float64 (rows, 2)."""
    t_s = dt_s * np.arange(rows, dtype=np.float64)
    columns = np.zeros((rows, 2))
    columns[:, 0] = 1.0
    if e.gain_drift:
        columns[:, 0] += e.gain_drift * np.expm1(-WARM_UP * t_s / t_s[-1]) / np.expm1(-WARM_UP)
    if e.gain_swing:
        columns[:, 0] += e.gain_swing * np.sin(2 * np.pi * t_s / SWING_S)
    if e.burst_m3s:
        columns[:, 1] = _bursts(t_s, rng)
    return columns


def _bursts(t_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Half sines of either sign at random times, float64 as t_s."""
    total = np.zeros_like(t_s)
    for start_s in rng.uniform(0, t_s[-1], rng.poisson(BURSTS_PER_S * t_s[-1])):
        height = rng.choice([-1, 1]) * rng.uniform(*BURST_HEIGHT)
        phase = (t_s - start_s) / rng.uniform(*BURST_S)
        inside = (phase > 0) & (phase < 1)
        total[inside] += height * np.sin(np.pi * phase[inside])
    return total
