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

from rtid.estimator.misfit import Misfit, residual_of
from rtid.estimator.solution import Solution
from rtid.estimator.state import Weights, variance
from rtid.estimator.track import stored_per_pressure
from rtid.model import Chamber, Machine
from rtid.plain import BoolArray, FloatArray, IntArray

HOT = 1.2  # mean squared innovation from which on a cell is weighed ...
CLEARLY = 4.0  # ... if it is so many standard deviations above 1
LEAST_ROWS = 20
STAY_S = 0.1  # longer stays are cut: what is missed changes with the working point
LEAST_S = 0.02  # time in a cell from which on a rate can be told


def weighed(model: Machine, chunk: FloatArray, weights: Weights, solution: Solution) -> Weights:
    """The weights with `missed` for every cell that needs it; those that had it keep it.

    chunk (n, 2 + signals): the record, SI.
    """
    residual = residual_of(model, chunk, weights, solution)
    return excusing(model, chunk, weights, residual, misses(model, residual).hot)


def excusing(
    model: Machine,
    chunk: FloatArray,
    weights: Weights,
    residual: Misfit,
    hot: BoolArray,
) -> Weights:
    """The weights with `missed`, m6/s, for the hot cells (cells,), and for those that had it.

    chunk (n, 2 + signals), SI.
    """
    hot = hot | (weights.missed > 0)
    if not hot.any():
        return weights
    return replace(weights, missed=np.where(hot, _rates(model, chunk, weights, residual), 0.0))


@dataclass(frozen=True)
class Misses:
    """Cells (cells,) that a record visits for long enough, and those that miss the flow there."""

    visited: BoolArray
    hot: BoolArray

    @property
    def share(self) -> float:
        """Of the visited cells that miss it."""
        return float(self.hot.sum() / max(1, self.visited.sum()))


def misses(model: Machine, residual: Misfit) -> Misses:
    """The cells whose innovations are clearly larger than the noise."""
    square = (residual.innovation**2).mean(axis=1)
    known, n_c = np.isfinite(square), residual.innovation.shape[1]
    hot, visited = np.zeros(model.n_cells, bool), np.zeros(model.n_cells, bool)
    for cells in residual.cells.T:
        here = known & (cells >= 0)
        rows = np.bincount(cells[here], minlength=model.n_cells)
        mean = np.bincount(cells[here], square[here], model.n_cells) / np.maximum(rows, 1)
        clear = mean > 1.0 + CLEARLY * np.sqrt(2.0 / (np.maximum(rows, 1) * n_c))
        visited |= rows >= LEAST_ROWS
        hot |= (rows >= LEAST_ROWS) & clear & (mean > HOT)
    return Misses(visited, hot)


@dataclass(frozen=True)
class _Stays:
    """Stays of a chamber's working points: interval of each one's start, T and G^2 - 2 R."""

    first: IntArray
    time_s: FloatArray
    excess_m6: FloatArray


def _rates(model: Machine, chunk: FloatArray, weights: Weights, residual: Misfit) -> FloatArray:
    """Variance rate of the missed flow per cell (cells,), m6/s; 0 where the noise explains all."""
    total, time_s = np.zeros(model.n_cells), np.zeros(model.n_cells)
    for c, chamber in enumerate(model.chambers):
        edges = [i for i, edge in enumerate(model.edges) if edge.sign(chamber) != 0]
        stays = _stays(model, chunk, weights, residual, c, edges)
        for i in edges:
            cell = residual.cells[stays.first, i]
            here = (cell >= 0) & (stays.time_s > 0)
            cell, lasted = cell[here], stays.time_s[here]
            noise = _pressure_noise(model, weights, i)[cell] * lasted
            total += np.bincount(cell, stays.excess_m6[here] - noise, model.n_cells)
            time_s += np.bincount(cell, lasted, model.n_cells)
    return np.where(time_s > LEAST_S, np.maximum(total, 0.0) / np.maximum(time_s, LEAST_S), 0.0)


def _stays(
    model: Machine,
    chunk: FloatArray,
    weights: Weights,
    residual: Misfit,
    c: int,
    edges: list[int],
) -> _Stays:
    missed = residual.missed[:, c]
    dt, known = np.diff(chunk[:, 0]), np.isfinite(missed)
    moved = (np.diff(residual.cells[:, edges], axis=0) != 0).any(axis=1)
    cut = np.diff(np.floor(chunk[1:, 0] / STAY_S)) != 0
    new = np.concatenate([[True], moved | cut | ~known[1:]])
    stay, n = np.cumsum(new) - 1, int(new.sum())
    noise = _position_noise(model, chunk[1:], weights, c)
    volume = np.bincount(stay[known], (missed * dt)[known], n)
    ends = 2.0 * np.bincount(stay, noise, n) / np.bincount(stay, minlength=n)
    lasted = np.bincount(stay[known], dt[known], n).astype(np.float64)
    return _Stays(np.flatnonzero(new), lasted, np.asarray(volume**2 - ends, np.float64))


def _position_noise(model: Machine, chunk: FloatArray, weights: Weights, c: int) -> FloatArray:
    """White noise of one row of a chamber at each sample (n,), m6."""
    chamber: Chamber = model.chambers[c]
    stiff = stored_per_pressure(model, chunk[:, 2:], weights.compliance)[:, c]
    position, pressure = (variance(model, s) for s in (model.position, chamber.pressure))
    return np.asarray(chamber.area_m2**2 * position + stiff**2 * pressure * model.pressure_share)


def _pressure_noise(model: Machine, weights: Weights, i: int) -> FloatArray:
    """Variance rate from pressure noise through the slope of edge i's map (cells,), m6/s."""
    edge, period_s = model.edges[i], model.pressure_period_s or 1e-3
    noise = variance(model, edge.source) + variance(model, edge.sink)
    return np.asarray(weights.slopes**2 * noise * period_s)
