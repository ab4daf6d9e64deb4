"""Fit of a plant to a record by the error of its free run, from many starts.

    minimise  sum over samples and outputs of  ((y - g(x(t; p, x0))) / scale)^2

The parameters' covariance counts the memory of the residual; directions in which the record says
nothing are named.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rtid.plain import BoolArray, FloatArray
from rtid.plants.plant import Plant, PlantError, PlantParameter, PlantRecord
from rtid.plants.problem import ROUGH, FitProblem, bounds, scales, steps
from rtid.plants.simulator import Simulator, resolved
from rtid.plants.statistics import covariance, memory

ALL, PARAMETERS, INITIAL = "all", "parameters", "initial values"  # what a fit may move
LATER = "later initial values"  # those of every part of the record but the first
STARTS = 64  # random starts that are run
POLISHED = 3  # the best of them that are fitted
MOST_RUNS = 60
ROUGH_RUNS = 8  # of the fit from a start that competes with others
ILL_CONDITIONED = 1e6  # of the Jacobian with columns of unit length
INFINITE_RANGE = 10.0  # of the start value, where a parameter has no bounds


@dataclass(frozen=True)
class PlantFit:
    """A fitted plant: values (unknowns,), residual (n, outputs), in the plant's units.

    The residual is NaN where nothing was measured or used.
    """

    simulator: Simulator
    values: FloatArray
    output: FloatArray
    states: FloatArray
    residual: FloatArray
    mask: BoolArray

    @cached_property
    def jacobian(self) -> FloatArray:
        """How the outputs change with the values (n, outputs, unknowns), in their units."""
        everywhere, moved = np.ones_like(self.mask), np.ones(len(self.values), bool)
        whole = FitProblem(self.simulator, self.values, moved, everywhere)
        slopes = whole.slopes(self.values / whole.step) / whole.step
        return slopes.reshape(*self.residual.shape, len(self.values)) * whole.scale[:, None]

    @property
    def plant(self) -> Plant:
        """The plant that was fitted."""
        return self.simulator.plant

    @property
    def sse(self) -> float:
        """Sum of squares in units of the outputs' scales."""
        scaled = self.residual / scales(self.simulator)
        return float(np.nansum(scaled**2))

    @property
    def rmse(self) -> FloatArray:
        """Root mean square of the free run's error (outputs,), in units of each."""
        return np.sqrt(np.nanmean(self.residual**2, axis=0))

    @property
    def samples(self) -> int:
        """Number of residuals."""
        return int(np.isfinite(self.residual).sum())

    @cached_property
    def worth(self) -> float:
        """Number of independent samples that the residuals are worth."""
        columns = self.residual.T
        return float(sum(np.isfinite(e).sum() / memory(e)[0] for e in columns))

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance (unknowns, unknowns), in units of the values; zero for those at a bound."""
        scale = scales(self.simulator)
        free = self.free
        cov = np.zeros((len(self.values), len(self.values)))
        some = covariance(self.jacobian[:, :, free] / scale[:, None], self.residual / scale)
        cov[np.ix_(free, free)] = some
        return cov

    @property
    def sd(self) -> FloatArray:
        """Standard deviation (unknowns,), in units of the values; NaN for those at a bound."""
        spread = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return np.where(self.free, spread, np.nan)

    @property
    def free(self) -> BoolArray:
        """Which values (unknowns,) are not held by a bound."""
        low, high = bounds(self.plant.unknowns)
        near = 1e-6 * steps(self.plant.unknowns)
        return (self.values - low > near) & (high - self.values > near)

    @cached_property
    def condition(self) -> tuple[float, tuple[str, ...]]:
        """Condition of the scaled Jacobian, and the unknowns of its weakest direction if ill."""
        free = np.flatnonzero(self.free)
        flat = (self.jacobian / scales(self.simulator)[:, None])[self.mask][:, free]
        length = np.linalg.norm(flat, axis=0)
        names = [self.plant.unknowns[k].name for k in free]
        if not len(free):
            return 1.0, ()
        if not length.all():
            return np.inf, tuple(n for n, size in zip(names, length, strict=True) if not size)
        _, sizes, directions = np.linalg.svd(flat / length, full_matrices=False)
        number = float(sizes[0] / max(sizes[-1], 1e-300))
        weak = np.abs(directions[-1]) > 0.1
        ill = number > ILL_CONDITIONED
        return number, tuple(n for n, w in zip(names, weak, strict=True) if w and ill)

    def value(self, name: str) -> tuple[float, float]:
        """Value and standard deviation of one unknown."""
        k = [p.name for p in self.plant.unknowns].index(name)
        return float(self.values[k]), float(self.sd[k])


def fit(
    plant: Plant,
    record: PlantRecord,
    starts: FloatArray | None = None,
    *,
    mask: BoolArray | None = None,
    polished: int = POLISHED,
    most_runs: int = MOST_RUNS,
    sub_steps: int = 1,
    fixed_step: bool = False,
    only: str = ALL,
) -> PlantFit:
    """Fit all unknowns, or only the parameters, or only (later) initial values of the states.

    starts (lanes, unknowns): where to start, the best of them are polished; None draws them between
    the bounds.  most_runs: of the last fit, 0 for a rough one.  mask (n, outputs): which outputs
    count.  sub_steps: at least so many per sample,
    exactly so many with a fixed step.  All in the plant's units.
    """
    used = record.used if mask is None else mask & record.used
    unknowns = plant.unknowns
    lanes = drawn(unknowns) if starts is None else np.atleast_2d(starts)
    opened = _opened(plant, only)
    simulator = (
        Simulator(plant, record, sub_steps)
        if fixed_step
        else _resolved(plant, record, lanes, sub_steps)
    )
    problem = FitProblem(simulator, lanes[0].copy(), opened, used)
    best = _best_start(problem, lanes, polished, most_runs)
    finer = simulator if fixed_step else resolved(plant, record, best, simulator.sub_steps)
    if finer.sub_steps > simulator.sub_steps:
        problem = FitProblem(finer, best, opened, used)
        best, _ = problem.solve(best, most_runs)
    return _finished(problem, best)


def _opened(plant: Plant, only: str) -> BoolArray:
    """Which unknowns a fit may move."""
    opened = np.ones(len(plant.unknowns), bool)
    if only != ALL:
        n = len(plant.parameters)
        opened[:n] = only == PARAMETERS
        opened[n : n + plant.initial_values] = only == INITIAL
        opened[n + plant.initial_values :] = only in (INITIAL, LATER)
    return opened


def _resolved(plant: Plant, record: PlantRecord, lanes: FloatArray, least: int) -> Simulator:
    """The step that the first start that can be run asks for."""
    for values in lanes[:-1]:
        try:
            return resolved(plant, record, values, least)
        except PlantError:
            continue
    return resolved(plant, record, lanes[-1], least)


def _best_start(
    problem: FitProblem, lanes: FloatArray, polished: int, most_runs: int
) -> FloatArray:
    cost = (problem.errors(lanes.T) ** 2).sum(axis=0)
    order = np.argsort(cost)[:polished]
    if len(order) > 1:  # a few steps show which starts lead to the same place
        rough = [problem.solve(lanes[k], ROUGH_RUNS, ROUGH) for k in order]
        best = min(rough, key=lambda r: r[1])[0]
        return problem.solve(best, most_runs)[0] if most_runs else best
    return problem.solve(lanes[order[0]], most_runs or ROUGH_RUNS)[0]


def _finished(problem: FitProblem, values: FloatArray) -> PlantFit:
    simulator = problem.simulator
    y, states = simulator.run(values[:, None])
    residual = np.where(problem.mask, simulator.record.y - y[:, :, 0], np.nan)
    return PlantFit(simulator, values, y[:, :, 0], states[:, :, 0], residual, problem.mask)


def drawn(unknowns: tuple[PlantParameter, ...], n: int = STARTS) -> FloatArray:
    """Start values (n, unknowns) in their units: the given ones, then drawn between the bounds."""
    rng = np.random.default_rng(0)
    lanes = np.empty((n, len(unknowns)))
    for k, p in enumerate(unknowns):
        reach = INFINITE_RANGE * max(abs(p.start), 1.0)
        low, high = max(p.low, p.start - reach), min(p.high, p.start + reach)
        if low > 0 and high / low > 10:
            lanes[:, k] = np.exp(rng.uniform(np.log(low), np.log(high), n))
        else:
            lanes[:, k] = rng.uniform(low, high, n)
    lanes[0] = [p.start for p in unknowns]
    return lanes
