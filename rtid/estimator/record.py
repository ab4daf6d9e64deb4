"""The record path: everything that a captured trace can tell, in a few passes of the live kernel.

1. one pass with nominal weights, as on board;
2. a pass with weights from the first result (slopes dQ/ddp of the learned maps, learned beta),
   which also tells the blocks whose terms miss the flow: they lose their say;
3. the declared lag as a nuisance parameter (`profile`), and a last pass with the value found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rtid.errors import ArgumentError, door
from rtid.estimator.correction import correct, plain
from rtid.estimator.factor import factor_of, one_thread
from rtid.estimator.misfit import can_be_explained, count_misfit
from rtid.estimator.missed import weighed
from rtid.estimator.profile import Profile, profile
from rtid.estimator.solution import Sketch, Solution, sketch, solve
from rtid.estimator.state import (
    State,
    Weights,
    build,
    nominal_weights,
    tell_unmarked,
    variance,
)
from rtid.estimator.sums import Sums
from rtid.model import Edge, Machine
from rtid.plain import FloatArray

LAG_PROBE = 0.1  # of the lag, plus 0.05 ms: distance of the finite differences
OFFSET_PROBE = 0.1  # of an offset's tolerance


Assemble = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class RecordFit:
    """Result of the record path: solution, weights (with the lag), and what was found as nuisance.

    lag_sd_s is 0 where the lag is not estimated; offsets_s (m,) and offsets_sd_s (m,) are the
    changes of the message offsets in the order in which they were asked for.
    """

    solution: Solution
    weights: Weights
    lag_sd_s: float
    offsets_s: FloatArray
    offsets_sd_s: FloatArray

    @property
    def lag_s(self) -> float:
        """The spools' lag that the record shows (or that was declared)."""
        return self.weights.lag_s


@door
def fit_record(
    model: Machine,
    chunk: FloatArray,
    assemble: Assemble | None = None,
    offset_tolerance_s: FloatArray | None = None,
    estimate_lag: bool = True,
) -> RecordFit:
    """Fit a whole record; chunk (n, 2 + signals) = [t_s, flags, values...] in SI units.

    assemble, where message offsets are unknown: gives the chunk for changes of the offsets (m,)
    in seconds, which are then estimated within offset_tolerance_s (m,).  estimate_lag = False keeps
    the declared lag: to first order it is the same as an offset of the command's message.
    """
    if chunk.shape[1:] != (2 + len(model.signals),):
        wanted = f"(n, {2 + len(model.signals)}) = [t_s, flags, one column per signal]"
        raise ArgumentError(f"fit_record: chunk must have the shape {wanted}, not {chunk.shape}")
    tell_unmarked(chunk[:, 1])
    if not estimate_lag:
        model = replace(model, lag=replace(model.lag, tolerance_s=0.0))
    tolerance = np.zeros(0) if offset_tolerance_s is None else offset_tolerance_s
    first = sketch(model, summed(model, chunk))
    weights, known = _excused(model, chunk, refined(model, first, model.lag.nominal_s))
    lag_sd_s, offsets, offsets_sd = 0.0, np.zeros(len(tolerance)), np.zeros(len(tolerance))
    if model.lag.tolerance_s > 0 or len(tolerance):
        result = _nuisance(model, assemble or (lambda _: chunk), weights, first.leverage, tolerance)
        lag_sd_s, offsets, offsets_sd = float(result.sd[0]), result.value[1:], result.sd[1:]
        weights = replace(weights, lag_s=float(result.value[0]))
        chunk = assemble(offsets) if assemble else chunk
        if len(tolerance):  # the first weights came from shifted signals
            weights = refined(model, sketch(model, summed(model, chunk, weights)), weights.lag_s)
        known = None
    if known is None:
        weights, known = _excused(model, chunk, weights)
    solution = count_misfit(model, chunk, weights, known or _solved(model, chunk, weights))
    return RecordFit(solution, weights, lag_sd_s, offsets, offsets_sd)


def _excused(
    model: Machine, chunk: FloatArray, weights: Weights
) -> tuple[Weights, Solution | None]:
    """The weights with those blocks excused whose terms miss the flow (`missed`).

    With them the solution, where none is and it is known.
    """
    if not can_be_explained(chunk):
        return weights, None
    solution = _solved(model, chunk, weights)
    better = weighed(model, chunk, weights, solution)
    return better, solution if better is weights else None


def _solved(model: Machine, chunk: FloatArray, weights: Weights) -> Solution:
    state = run(model, chunk, weights)
    return solve(model, state, counters=state.counters)


def _nuisance(
    model: Machine,
    assemble: Assemble,
    weights: Weights,
    leverage: FloatArray,
    tolerance_s: FloatArray,
) -> Profile:
    """Profile chi2 over [lag, message offsets]; their tolerances are prior knowledge."""

    def chi2(nu: FloatArray) -> float:
        return excess(model, assemble(nu[1:]), replace(weights, lag_s=float(nu[0])), leverage)

    lag = model.lag
    return profile(
        chi2,
        nominal=np.array([lag.nominal_s, *np.zeros(len(tolerance_s))]),
        tolerance=np.array([lag.tolerance_s, *tolerance_s]),
        probe=np.array([LAG_PROBE * lag.nominal_s + 5e-5, *(OFFSET_PROBE * tolerance_s)]),
        least=np.array([0.0, *np.full(len(tolerance_s), -np.inf)]),
        stages=(3.0, 1.0) if len(tolerance_s) else (1.0,),
    )


def run(model: Machine, chunk: FloatArray, weights: Weights | None = None) -> State:
    """State after one pass over the record, chunk (n, 2 + signals), SI."""
    state = build(model, weights)
    state.advance(chunk)
    return state


def summed(model: Machine, chunk: FloatArray, weights: Weights | None = None) -> Sums:
    """The sums over one pass, chunk (n, 2 + signals), SI; the state that took them is let go."""
    return Sums.ended(run(model, chunk, weights))


def refined(model: Machine, sketched: Sketch, lag_s: float) -> Weights:
    """Weights from a first estimate: the slopes dQ/ddp of its own map, whatever the valves' law.

    The noise of a pressure enters by the slope that is fitted, not by the true one: where dp hardly
    moves in a block that slope is next to nothing, and the orifice's would count noise that is not
    there.  No valve's flow rises faster than in proportion to dp.  The noise of a command, known at
    its samples only, enters by dQ/dw: as so much more noise of dp.

    A compliance outside its declared bounds tells that the motion did not show it.
    """
    slopes = nominal_weights(model).slopes.copy()
    span = np.concatenate([_span(edge) for edge in model.maps])
    known = np.isfinite(sketched.flow_m3s)
    cells = sketched.cells[known]
    proportional = 2.0 * np.maximum(sketched.flow_m3s[known], 0.0) / span[cells]
    by_command = sketched.gain[known] * _command_noise(model)[cells]
    slopes[cells] = np.hypot(np.minimum(sketched.slope[known], proportional), by_command)
    low, high = 1 / model.beta_bounds_pa[1], 1 / model.beta_bounds_pa[0]
    possible = (sketched.compliance >= low) & (sketched.compliance <= high)
    compliance = np.where(possible, sketched.compliance, 1 / model.beta_nominal_pa)
    return Weights(slopes, compliance, lag_s)


def _command_noise(model: Machine) -> FloatArray:
    """Noise of the command over that of dp, for each cell (cells,), V/Pa."""
    shares = []
    for edge in model.maps:
        noise = model.signals[model.column(edge.command)].noise
        dp_pa2 = variance(model, edge.source) + variance(model, edge.sink)
        shares.append(np.full(edge.grid.shape, noise / np.sqrt(dp_pa2) if dp_pa2 else 0.0).ravel())
    return np.concatenate(shares)


def _span(edge: Edge) -> FloatArray:
    """2 |dp| at each cell's centre, at least the cell's own height: (cells,)."""
    dp = edge.grid.dp_pa
    return np.tile(np.maximum(np.abs(dp[1:] + dp[:-1]), np.diff(dp)), edge.grid.shape[0])


def excess(model: Machine, chunk: FloatArray, weights: Weights, leverage: FloatArray) -> float:
    """Cost of the best linear fit minus its number of rows: comparable between nuisance values.

    chunk (n, 2 + signals), SI; leverage (chambers,): shares, as in `correct`.
    """
    sums = summed(model, chunk, weights)
    with one_thread():
        corrected = correct(sums, *plain(sums, factor_of(sums)), leverage)
    return corrected.cost - sums.rows * len(model.chambers)
