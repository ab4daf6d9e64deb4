"""What the residual depends on: its mean over bins of every signal, by direction, over time.

The filtered residual is correlated in time: n rows tell as much as n / f of them, with
f = 1 + 2 sum of its autocorrelations up to the first that is not positive.  A bin's error is

    standard error = sd of the bin's rows sqrt(f / n).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.compare.comparison import Comparison
from rtid.effects.extra import VOLUME
from rtid.model import POSITION, VELOCITY, Machine
from rtid.plain import FloatArray, IntArray

BINS, TIME_BINS = 16, 24
LEAST_ROWS = 8  # rows that a bin needs
EDGE = 0.005  # of the rows at either end of a signal's range are left to the outer bins
RESTING = 0.02  # of the largest speed: slower is standstill
MOST_LAG = 50
TIME, RATE = "time", "velocity"
DIRECTIONS = ("retracting", "resting", "extending")


@dataclass(frozen=True)
class Dependence:
    """Mean residual of c chambers over b bins of one signal (SI, through the same filter).

    low, high, centre (b,): ends and mean of the rows' values; mean_m3s, error_m3s (b, c): mean and
    its standard error; rms_m3s (b, c); rows (b,).  explained (c,): share of the residual's variance
    that the bins' means explain, beyond what chance gives.
    """

    signal: str
    unit: str
    low: FloatArray
    high: FloatArray
    centre: FloatArray
    mean_m3s: FloatArray
    error_m3s: FloatArray
    rms_m3s: FloatArray
    rows: IntArray
    explained: FloatArray


def against_signals(model: Machine, part: Comparison, bins: int = BINS) -> list[Dependence]:
    """Dependence on every signal that varies; on the position's rate where no velocity is there."""
    dependences = []
    velocity = part.measured_m3s[:, 0] / (model.chambers[0].area_m2 * model.chambers[0].sign)
    columns = [
        (s.name, s.unit, part.signals[:, k])
        for k, s in enumerate(model.signals)
        if s.kind != VOLUME
    ]
    kinds = [s.kind for s in model.signals]
    if VELOCITY not in kinds and POSITION in kinds:
        columns.append((RATE, "m/s", velocity))
    for name, unit, values in columns:
        if len(values) and np.ptp(values) > 1e-9 * (np.abs(values).max() + 1e-30):
            dependences.append(binned(name, unit, values, part.residual_m3s, bins))
    return dependences


def across_piston(model: Machine, part: Comparison) -> list[Dependence]:
    """Dependence on the pressure difference of two chambers: what creeps past a seal follows it."""
    names = [signal.name for signal in model.signals]
    pressures = [c.pressure for c in model.chambers if c.pressure in names]
    if len(pressures) != 2 or not len(part.signals):
        return []
    first, second = (part.signals[:, names.index(name)] for name in pressures)
    return [binned(" - ".join(pressures), "Pa", first - second, part.residual_m3s)]


def over_time(part: Comparison, bins: int = TIME_BINS) -> Dependence:
    """Dependence on time."""
    t_s = part.t_s if len(part.t_s) else np.zeros(1)
    edges = np.linspace(t_s[0], t_s[-1] + 1e-9, bins + 1)
    return _binned(TIME, "s", part.t_s, edges, part.residual_m3s)


def by_direction(model: Machine, part: Comparison) -> Dependence:
    """Dependence on the direction of motion: three bins in the order of DIRECTIONS."""
    speed = part.measured_m3s[:, 0] / (model.chambers[0].area_m2 * model.chambers[0].sign)
    fast = np.quantile(np.abs(speed), 0.99) if len(speed) else 1.0
    rest = RESTING * max(float(fast), 1e-12)
    edges = np.array([-np.inf, -rest, rest, np.inf])
    return _binned("direction", "m/s", speed, edges, part.residual_m3s, least=1)


def binned(
    name: str, unit: str, values: FloatArray, residual: FloatArray, bins: int = BINS
) -> Dependence:
    """Dependence of residual (rows, c), m3/s, in the order of time, on values (rows,) in `unit`."""
    return _binned(name, unit, values, _edges(values, bins), residual)


def _edges(values: FloatArray, bins: int) -> FloatArray:
    low, high = np.quantile(values, [EDGE, 1.0 - EDGE])
    edges = np.linspace(low, max(high, low + 1e-12 * max(1.0, abs(low))), bins + 1)
    edges[0], edges[-1] = min(edges[0], values.min()), max(edges[-1], values.max())
    return edges


def _binned(
    name: str,
    unit: str,
    values: FloatArray,
    edges: FloatArray,
    residual: FloatArray,
    least: int = LEAST_ROWS,
) -> Dependence:
    n = len(edges) - 1
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, n - 1)
    rows = np.bincount(index, minlength=n)
    kept = np.flatnonzero(rows >= least)
    count = rows[kept, None].astype(float)

    def mean(y: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(index, y, n)[kept], float)

    total = np.stack([mean(r) for r in residual.T], axis=1)
    square = np.stack([mean(r**2) for r in residual.T], axis=1)
    average = total / count
    spread = np.maximum(square / count - average**2, 0.0) * count / np.maximum(count - 1, 1)
    inflation = np.array([inflation_of(r) for r in residual.T])
    error = np.sqrt(spread * inflation / count)
    explained = _explained(residual, average, count, inflation)
    return Dependence(
        name,
        unit,
        edges[:-1][kept],
        edges[1:][kept],
        mean(values) / count[:, 0],
        average,
        error,
        np.sqrt(square / count),
        rows[kept],
        explained,
    )


def _explained(
    residual: FloatArray, average: FloatArray, count: FloatArray, inflation: FloatArray
) -> FloatArray:
    """Share of the variance between bins less the share that bins of pure noise would show."""
    if not len(count):
        return np.zeros(residual.shape[1])
    variance = np.maximum(residual.var(axis=0), 1e-300)
    grand = (average * count).sum(axis=0) / count.sum()
    between = ((average - grand) ** 2 * count).sum(axis=0) / count.sum()
    chance = inflation * (len(count) - 1) / count.sum()
    return np.asarray(np.clip((between / variance - chance), 0.0, 1.0))


def inflation_of(residual: FloatArray) -> float:
    """How many of the rows (rows,), any unit, tell as much as one independent row; at least 1."""
    r = residual - residual.mean() if len(residual) else residual
    power = float(r @ r)
    total = 0.0
    for lag in range(1, min(MOST_LAG, len(r) // 4)):
        correlation = float(r[lag:] @ r[:-lag]) / power if power > 0 else 0.0
        if correlation <= 0.0:
            break
        total += correlation
    return 1.0 + 2.0 * total
