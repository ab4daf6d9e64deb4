"""Find a timing parameter from afar: exact refits on a coarser map, then the fine one.

The cost of a wrong delay is not a parabola: far from the truth the fitted map is bent, and its
derivatives point nowhere.  So each timing is first tried at the values of its bank, and the best is
closed in on; half the blocks per axis are enough to tell which is best.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from rtid.diagnose.candidates import Columns
from rtid.diagnose.commands import Timings, split, transformed
from rtid.diagnose.evidence import project, rows_of
from rtid.diagnose.fit import Fit, columns_of_effects, prepare
from rtid.diagnose.timing import Psi, Timing
from rtid.estimator.state import Weights
from rtid.model import FloatArray, Grid, Model

ROW_S = 20e-3  # long rows are enough
SIMPLEX, DOWNHILL = 0.25, 80  # first size in logarithms of the parameters; refits
KEPT = 0.995  # of the rows that must stay on the grids: what is left out cannot misfit
CLOSING = 5  # refits between the neighbours of the best of the bank


def coarse(model: Model) -> Model:
    """The same machine with every second border of its maps."""
    edges = []
    for edge in model.edges:
        u, dp = (_thinned(b) for b in (edge.grid.u_v, edge.grid.dp_pa))
        edges.append(replace(edge, grid=Grid(u, dp)))
    return replace(model, edges=tuple(edges))


def _thinned(border: FloatArray) -> FloatArray:
    kept = border[::2]
    return kept if kept[-1] == border[-1] else np.append(kept, border[-1])


class Search:
    """Costs of revisions on the coarse map of one record."""

    def __init__(self, model: Model, chunk: FloatArray) -> None:
        self.model, self.chunk = coarse(model), chunk
        self.split = split(self.model)
        self.weights: Weights = prepare(self.model, chunk)
        self.most_rows = 0

    def best(self, timing: Timing, beside: Fit, enough: float) -> tuple[Psi, float]:
        """The parameters of a timing that lower the cost most beside a fit, and by how much.

        enough: a bank that lowers it by less is not closed in on.
        """
        bank, before = list(timing.bank), self.cost((), beside)
        cost = [self.cost(((timing, psi),), beside) for psi in bank]
        k = int(np.argmin(cost))
        if before - cost[k] < enough:
            return bank[k], before - cost[k]
        ends = [np.log(psi[0]) for psi in bank]
        ends = [2 * ends[0] - ends[1], *ends, 2 * ends[-1] - ends[-2]]
        low, middle, high = ends[k : k + 3]
        psi, best = bank[k], cost[k]
        for _ in range(CLOSING):
            below = middle - low > high - middle
            trial = 0.5 * (low + middle) if below else 0.5 * (middle + high)
            moved = (float(np.clip(np.exp(trial), timing.low[0] or 0.0, timing.high[0])), *psi[1:])
            found = self.cost(((timing, moved),), beside)
            if found < best:
                low, high = (low, middle) if below else (middle, high)
                middle, psi, best = trial, moved, found
            elif below:
                low = trial
            else:
                high = trial
        return psi, before - best

    def polished(self, timing: Timing, bank: list[Psi], beside: Fit) -> Psi:
        """The best of a bank for a timing of several parameters, and from there downhill.

        Where parameters bend each other, a simplex finds the way that derivatives miss.
        """

        def cost(logs: FloatArray) -> float:
            psi = tuple(np.clip(np.exp(logs), timing.low, timing.high))
            return self.cost(((timing, psi),), beside)

        starts = [np.log(np.array(psi)) for psi in bank]
        start = min(starts, key=cost)
        simplex = np.vstack([start, start + SIMPLEX * np.eye(len(start))])
        options: Any = {"maxfev": DOWNHILL, "initial_simplex": simplex}
        found = minimize(cost, start, method="Nelder-Mead", options=options)
        return tuple(float(v) for v in np.clip(np.exp(found.x), timing.low, timing.high))

    def cost(self, more: Timings, beside: Fit) -> float:
        """Residual sum of squares of a revision with more timings; inf where it loses rows."""
        timings = (*beside.revision.timings, *more)
        sent = transformed(self.model, self.chunk, timings)
        weights = self.weights
        if any(t.replaces_lag for t, _ in timings):
            weights = replace(weights, lag_s=0.0)
        rows = rows_of(self.split, sent, weights, ROW_S)
        self.most_rows = max(self.most_rows, rows.n)
        if rows.n < KEPT * self.most_rows:
            return float("inf")
        columns = Columns(rows.condensed)
        for volumes in columns_of_effects(beside):
            columns.add(volumes)
        s = project(rows, columns.released()).schur
        theta = np.linalg.lstsq(s[1:, 1:], s[1:, 0], rcond=1e-12)[0]
        return float(s[0, 0] - s[0, 1:] @ theta)
