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
from rtid.model import Machine
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
    soft: FloatArray | None = None,
) -> Weights:
    """The weights with `missed`, m6/s, for the hot cells (cells,), and for those that had it.

    chunk (n, 2 + signals), SI; soft (n, chambers): white variance of each measured position's
    equation, m6, beyond that of the model.
    """
    hot = hot | (weights.missed > 0)
    if not hot.any():
        return weights
    noise = _position_noise(model, chunk, weights) + (0.0 if soft is None else soft)
    rates = _rates(model, chunk, weights, residual, noise[1:])
    return replace(weights, missed=np.where(hot, rates, 0.0))


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


def _rates(
    model: Machine, chunk: FloatArray, weights: Weights, residual: Misfit, white: FloatArray
) -> FloatArray:
    """Variance rate of the missed flow per cell (cells,), m6/s; 0 where the noise explains all.

    white (n - 1, chambers): noise of one row at the end of each interval, m6.
    """
    total, time_s = np.zeros(model.n_cells), np.zeros(model.n_cells)
    for c, chamber in enumerate(model.chambers):
        edges = [i for i, edge in enumerate(model.edges) if edge.sign(chamber) != 0]
        stays = _stays(chunk, residual, white[:, c], c, edges)
        for i in edges:
            cell = residual.cells[stays.first, i]
            here = (cell >= 0) & (stays.time_s > 0)
            cell, lasted = cell[here], stays.time_s[here]
            noise = _pressure_noise(model, weights, i)[cell] * lasted
            total += np.bincount(cell, stays.excess_m6[here] - noise, model.n_cells)
            time_s += np.bincount(cell, lasted, model.n_cells)
    return np.where(time_s > LEAST_S, np.maximum(total, 0.0) / np.maximum(time_s, LEAST_S), 0.0)


def _stays(
    chunk: FloatArray, residual: Misfit, white: FloatArray, c: int, edges: list[int]
) -> _Stays:
    missed = residual.missed[:, c]
    dt, known = np.diff(chunk[:, 0]), np.isfinite(missed)
    moved = (np.diff(residual.cells[:, edges], axis=0) != 0).any(axis=1)
    cut = np.diff(np.floor(chunk[1:, 0] / STAY_S)) != 0
    new = np.concatenate([[True], moved | cut | ~known[1:]])
    stay, n = np.cumsum(new) - 1, int(new.sum())
    volume = np.bincount(stay[known], (missed * dt)[known], n)
    ends = 2.0 * np.bincount(stay, white, n) / np.bincount(stay, minlength=n)
    lasted = np.bincount(stay[known], dt[known], n).astype(np.float64)
    return _Stays(np.flatnonzero(new), lasted, np.asarray(volume**2 - ends, np.float64))


def _position_noise(model: Machine, chunk: FloatArray, weights: Weights) -> FloatArray:
    """White noise of one row of each chamber at each sample (n, chambers), m6."""
    stiff = stored_per_pressure(model, chunk[:, 2:], weights.compliance)
    of_x, share = variance(model, model.position), model.pressure_share
    noise = [
        chamber.area_m2**2 * of_x + stiff[:, c] ** 2 * variance(model, chamber.pressure) * share
        for c, chamber in enumerate(model.chambers)
    ]
    return np.stack(noise, axis=1)


def _pressure_noise(model: Machine, weights: Weights, i: int) -> FloatArray:
    """Variance rate from pressure noise through the slope of edge i's map (cells,), m6/s."""
    edge, period_s = model.edges[i], model.pressure_period_s or 1e-3
    noise = variance(model, edge.source) + variance(model, edge.sink)
    return np.asarray(weights.slopes**2 * noise * period_s)
