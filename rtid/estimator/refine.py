"""Grid refinement: narrower intervals where a block's terms miss the flow by more than the noise.

A block whose innovations exceed unit variance holds what its six terms cannot follow, as a rule the
corner of the dead band.  The intervals with the largest excess are halved, and the finer grid is
kept when it explains more than its new unknowns would by chance (Schwarz's criterion).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.estimator.misfit import Misfit, residual_of
from rtid.estimator.record import RecordFit, fit_record
from rtid.estimator.solution import Solution
from rtid.model import Edge, Grid, Machine
from rtid.plain import FloatArray

ROUNDS = 4
AT_ONCE = 2  # intervals halved per axis and edge in one round
CLEARLY = 4.0  # standard deviations above unit variance
LEAST_ROWS = 200  # in an interval: fewer cannot tell a misfit from a few odd rows


@dataclass(frozen=True)
class Excess:
    """Per cell of one edge (nu, nd): rows seen, and squared innovations beyond one each."""

    rows: FloatArray
    beyond: FloatArray


def refine(model: Machine, chunk: FloatArray, rounds: int = ROUNDS) -> tuple[Machine, RecordFit]:
    """Fit a record, chunk (n, 2 + signals), SI, its grid as fine as it needs; model and fit."""
    fit = fit_record(model, chunk)
    misfit = _left(model, chunk, fit)
    for _ in range(rounds):
        result = excesses(model, misfit)
        edges = tuple(_halved(e, x) for e, x in zip(model.edges, result, strict=True))
        finer = replace(model, edges=edges)
        if finer.n_cells == model.n_cells:
            break
        trial = fit_record(finer, chunk)
        left_then = _left(finer, chunk, trial)
        if criterion(left_then, trial.solution) >= criterion(misfit, fit.solution):
            break
        model, fit, misfit = finer, trial, left_then
    return model, fit


def _left(model: Machine, chunk: FloatArray, fit: RecordFit) -> Misfit:
    """What a fit leaves, in units of the noise alone: excuses would hide a misfit."""
    plain = replace(fit.weights, missed=np.zeros(len(fit.weights.missed)))
    return residual_of(model, chunk, plain, fit.solution)


def criterion(misfit: Misfit, solution: Solution) -> float:
    """Schwarz's criterion: squared innovations and what the unknowns cost."""
    known, rows = len(solution.unknowns), int(np.isfinite(misfit.innovation).sum())
    return float(np.nansum(misfit.innovation**2) + known * np.log(max(rows, 1)))


def excesses(model: Machine, misfit: Misfit) -> list[Excess]:
    """Where the innovations of a fit exceed the noise, per edge."""
    square = (misfit.innovation**2).mean(axis=1) - 1.0
    known = np.isfinite(square)
    result = []
    for i, (edge, first) in enumerate(zip(model.edges, model.first_cells, strict=True)):
        size = edge.grid.shape[0] * edge.grid.shape[1]
        place = misfit.cells[known, i] - first
        here = (place >= 0) & (place < size)
        rows = np.bincount(place[here], minlength=size).astype(np.float64)
        total = np.bincount(place[here], square[known][here], size).astype(np.float64)
        result.append(Excess(rows.reshape(edge.grid.shape), total.reshape(edge.grid.shape)))
    return result


def _halved(edge: Edge, excess: Excess) -> Edge:
    """The edge with its worst intervals halved; as it is where none is clearly above the noise."""
    axes = [_worst(excess, axis) for axis in (0, 1)]
    u, dp = (_split(b, k) for b, k in zip((edge.grid.u_v, edge.grid.dp_pa), axes, strict=True))
    return replace(edge, grid=Grid(u, dp))


def _worst(excess: Excess, axis: int) -> list[int]:
    """Intervals along an axis whose excess is clear and holds a fair share of all of it."""
    rows, beyond = excess.rows.sum(axis=1 - axis), excess.beyond.sum(axis=1 - axis)
    clear = (rows >= LEAST_ROWS) & (beyond > CLEARLY * np.sqrt(2.0 * rows))
    share = beyond > 0.2 * max(float(beyond[beyond > 0].sum()), 1e-12)
    worst = np.argsort(-beyond)[:AT_ONCE]
    return [int(k) for k in worst if clear[k] and share[k]]


def _split(border: FloatArray, intervals: list[int]) -> FloatArray:
    middle = [0.5 * (border[k] + border[k + 1]) for k in intervals]
    return np.sort(np.concatenate([border, middle]))
