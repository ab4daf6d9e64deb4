"""Blocks whose terms miss the flow lose their say in the shared unknowns.

Where six terms cannot follow a map, as at the corner of the dead band, the missed flow would bend
the compliances and the lag.  Such a cell gets a variance rate of its own (m6/s), which the whitener
adds while the working point is there.  From the volume G that the fit misses on each stay of length
T in the cell, beyond what position noise (R per end) and pressure noise (q T) explain,

    missed = max(0, sum of (G^2 - 2 R - q T)) / sum of T.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtid.estimator.misfit import Residual, residual_of
from rtid.estimator.solution import Solution
from rtid.estimator.state import Weights, variance
from rtid.model import Chamber, FloatArray, Model

HOT = 1.2  # mean squared innovation from which on a cell is weighed ...
CLEARLY = 4.0  # ... if it is so many standard deviations above 1
LEAST_ROWS = 20
STAY_S = 0.1  # longer stays are cut: what is missed changes with the working point
LEAST_S = 0.02  # time in a cell from which on a rate can be told

IntArray = NDArray[np.int64]


def weighed(model: Model, chunk: FloatArray, weights: Weights, solution: Solution) -> Weights:
    """The weights with `missed` for every cell that needs it; those that had it keep it."""
    residual = residual_of(model, chunk, weights, solution)
    hot = _is_hot(model, residual) | (weights.missed > 0)
    if not hot.any():
        return weights
    return replace(weights, missed=np.where(hot, _rates(model, chunk, weights, residual), 0.0))


def _is_hot(model: Model, residual: Residual) -> NDArray[np.bool_]:
    """Cells (cells,) whose innovations are clearly larger than the noise."""
    square = (residual.innovation**2).mean(axis=1)
    known, n_c = np.isfinite(square), residual.innovation.shape[1]
    hot = np.zeros(model.n_cells, bool)
    for cells in residual.cells.T:
        here = known & (cells >= 0)
        rows = np.bincount(cells[here], minlength=model.n_cells)
        mean = np.bincount(cells[here], square[here], model.n_cells) / np.maximum(rows, 1)
        clear = mean > 1.0 + CLEARLY * np.sqrt(2.0 / (np.maximum(rows, 1) * n_c))
        hot |= (rows >= LEAST_ROWS) & clear & (mean > HOT)
    return hot


@dataclass(frozen=True)
class _Stays:
    """Stays of a chamber's working points: interval of each one's start, T and G^2 - 2 R."""

    first: IntArray
    time_s: FloatArray
    excess_m6: FloatArray


def _rates(model: Model, chunk: FloatArray, weights: Weights, residual: Residual) -> FloatArray:
    """Variance rate of the missed flow per cell (cells,), m6/s; 0 where the noise explains all."""
    total, time_s = np.zeros(model.n_cells), np.zeros(model.n_cells)
    for c, chamber in enumerate(model.chambers):
        own = [i for i, edge in enumerate(model.edges) if edge.sign(chamber) != 0]
        stays = _stays(model, chunk, weights, residual, c, own)
        for i in own:
            cell = residual.cells[stays.first, i]
            here = (cell >= 0) & (stays.time_s > 0)
            cell, lasted = cell[here], stays.time_s[here]
            noise = _pressure_noise(model, weights, i)[cell] * lasted
            total += np.bincount(cell, stays.excess_m6[here] - noise, model.n_cells)
            time_s += np.bincount(cell, lasted, model.n_cells)
    return np.where(time_s > LEAST_S, np.maximum(total, 0.0) / np.maximum(time_s, LEAST_S), 0.0)


def _stays(
    model: Model,
    chunk: FloatArray,
    weights: Weights,
    residual: Residual,
    c: int,
    own: list[int],
) -> _Stays:
    missed = residual.flow[:, 2 * c] - residual.flow[:, 2 * c + 1]
    dt, known = np.diff(chunk[:, 0]), np.isfinite(missed)
    moved = (np.diff(residual.cells[:, own], axis=0) != 0).any(axis=1)
    cut = np.diff(np.floor(chunk[1:, 0] / STAY_S)) != 0
    new = np.concatenate([[True], moved | cut | ~known[1:]])
    stay, n = np.cumsum(new) - 1, int(new.sum())
    noise = _position_noise(model, chunk[1:], weights, c)
    volume = np.bincount(stay[known], (missed * dt)[known], n)
    ends = 2.0 * np.bincount(stay, noise, n) / np.bincount(stay, minlength=n)
    lasted = np.bincount(stay[known], dt[known], n).astype(np.float64)
    return _Stays(np.flatnonzero(new), lasted, np.asarray(volume**2 - ends, np.float64))


def _position_noise(model: Model, chunk: FloatArray, weights: Weights, c: int) -> FloatArray:
    """White noise of one row of a chamber at each sample (n,), m6."""
    chamber: Chamber = model.chambers[c]
    area = chamber.sign * chamber.area_m2
    volume = chamber.v0_m3 + area * chunk[:, 2 + model.column(model.position)]
    stiff = volume * weights.compliance[c]
    position, pressure = (variance(model, s) for s in (model.position, chamber.pressure))
    return np.asarray(area**2 * position + stiff**2 * pressure * model.pressure_share)


def _pressure_noise(model: Model, weights: Weights, i: int) -> FloatArray:
    """Variance rate from pressure noise through the slope of edge i's map (cells,), m6/s."""
    edge, period_s = model.edges[i], model.pressure_period_s or 1e-3
    noise = variance(model, edge.source) + variance(model, edge.sink)
    return np.asarray(weights.slopes**2 * noise * period_s)
