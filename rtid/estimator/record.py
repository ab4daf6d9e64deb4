"""The record path: everything that a captured trace can tell, in a few passes of the live kernel.

1. one pass with nominal weights, as on board;
2. a pass with weights from the first result (slopes dQ/ddp of the learned maps, learned beta);
3. the declared lag as a nuisance parameter: chi2(tau), profiled over all other unknowns, has its
   minimum where Newton steps on a parabola through three points lead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.estimator.solution import VALID, Solution, factorize, misfit, normal_equations, solve
from rtid.estimator.state import State, Weights, build, nominal_weights
from rtid.model import FloatArray, Model

LAG_STEPS = 4  # parabolas at the most
LAG_PROBE = 0.15  # of the lag (plus 0.1 ms): distance of the two outer points


@dataclass(frozen=True)
class RecordFit:
    """Result of the record path: the solution, its weights, the lag and its standard deviation."""

    solution: Solution
    state: State
    weights: Weights
    lag_s: float
    lag_sd_s: float


def fit_record(model: Model, chunk: FloatArray) -> RecordFit:
    """Fit a whole record; chunk (n, 2 + signals) = [t_s, flags, values...] in SI units."""
    weights = refined(model, solve(model, run(model, chunk)), model.lag.nominal_s)
    lag_s, lag_sd_s = model.lag.nominal_s, 0.0
    if model.lag.tolerance_s > 0:
        lag_s, lag_sd_s = profile_lag(model, chunk, weights)
    weights = Weights(weights.slopes, weights.compliance, lag_s)
    state = run(model, chunk, weights)
    return RecordFit(solve(model, state), state, weights, lag_s, lag_sd_s)


def run(model: Model, chunk: FloatArray, weights: Weights | None = None) -> State:
    """State after one pass over the record."""
    state = build(model, weights)
    state.advance(chunk)
    return state


def refined(model: Model, solution: Solution, lag_s: float) -> Weights:
    """Weights from a solution: the orifice slope Q / (2 dp) at the mean flow of each valid block."""
    nominal = nominal_weights(model)
    slopes, first = nominal.slopes.copy(), _first_cells(model)
    for block in solution.blocks:
        if block.status == VALID:
            grid = model.edges[block.edge].grid
            dp = abs(0.5 * (grid.dp_pa[block.j] + grid.dp_pa[block.j + 1]))
            least = 0.5 * (grid.dp_pa[block.j + 1] - grid.dp_pa[block.j])
            cell = first[block.edge] + block.i * grid.shape[1] + block.j
            slopes[cell] = max(block.mean_flow_m3s, 0.0) / (2 * max(dp, least))
    low, high = 1 / model.beta_bounds_pa[1], 1 / model.beta_bounds_pa[0]
    return Weights(slopes, np.clip(solution.compliance, low, high), lag_s)


def _first_cells(model: Model) -> list[int]:
    sizes = [edge.grid.shape[0] * edge.grid.shape[1] for edge in model.edges]
    return [0, *np.cumsum(sizes)[:-1].tolist()]


def profile_lag(model: Model, chunk: FloatArray, weights: Weights) -> tuple[float, float]:
    """Lag and its standard deviation, the declared tolerance taken as prior knowledge."""

    def chi2(lag_s: float) -> float:
        state = run(model, chunk, Weights(weights.slopes, weights.compliance, lag_s)).settled()
        normal = normal_equations(state)
        theta = factorize(normal, int(state.engine[0]["n_shared"])).theta(normal.right)
        prior = ((lag_s - model.lag.nominal_s) / model.lag.tolerance_s) ** 2
        return misfit(normal, theta) + prior

    lag_s = model.lag.nominal_s
    for _ in range(LAG_STEPS):
        h = min(LAG_PROBE * lag_s + 1e-4, 0.9 * lag_s) if lag_s > 0 else 1e-4
        below, here, above = chi2(lag_s - h) if lag_s > h else np.inf, chi2(lag_s), chi2(lag_s + h)
        step, sd = _parabola(below, here, above, h)
        lag_s = max(0.0, lag_s + step)
        if abs(step) < max(0.5 * sd, 1e-6):
            break
    return lag_s, sd


def _parabola(below: float, here: float, above: float, h: float) -> tuple[float, float]:
    """Step to the minimum, at most 3 h, and the standard deviation from the curvature."""
    if not np.isfinite(below):
        return (h if above < here else 0.0), h
    curvature = (below - 2 * here + above) / h**2
    if curvature <= 0:
        return (h if above < below else -h), h
    return float(np.clip((below - above) / (2 * h * curvature), -3 * h, 3 * h)), (2 / curvature) ** 0.5
