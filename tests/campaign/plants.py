"""One random plant, learned from and scored against what only the simulator knows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np

from rtid.estimator.chunk import to_chunk
from rtid.estimator.flowmap import VALID
from rtid.estimator.record import RecordFit
from rtid.estimator.state import build
from rtid.kernels.explain import explain
from rtid.model import Grid, Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model, default_grid
from rtid.sim.random_plants import draw
from rtid.sim.run import Run, Sensors, SimulationError, simulate
from rtid.study.known_effects import learned

WORKERS = 2


@dataclass(frozen=True)
class Trial:
    """What is drawn: the plant's seed, the motion, its length, the pressure noise."""

    seed: int
    motion: str = "rich"
    duration_s: float = 15.0
    p_noise_pa: float = 5e3


@dataclass(frozen=True)
class Score:
    """Errors in units of their stated standard deviation, and relative errors.

    beta_z and beta_error (chambers,); block_z (blocks,): mean flow of each valid block;
    block_error: the same as shares of the edge's largest true flow; lag_error_s; rho.
    """

    trial: Trial
    beta_z: FloatArray
    beta_error: FloatArray
    block_z: FloatArray
    block_error: FloatArray
    lag_error_s: float
    rho: float


def scores(trials: Iterable[Trial]) -> Iterator[Score]:
    """Scores of all trials that could be simulated, on WORKERS processes."""
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        for found in pool.map(score, trials, chunksize=4):
            if found is not None:
                yield found


def score(trial: Trial) -> Score | None:
    """One trial; None where the drawn machine leaves its stroke or cavitates."""
    plant = draw(trial.seed)
    sensors = replace(Sensors(), p_noise_pa=trial.p_noise_pa)
    try:
        run = simulate(plant, trial.motion, trial.seed, trial.duration_s, sensors)
    except SimulationError:
        return None
    model = declared_model(plant, sensors=sensors, seed=trial.seed, grid=grid(plant.p_supply_pa))
    chunk = to_chunk(model, run.samples, 0)
    fit = learned(model, chunk)
    solution = fit.solution
    z, error = block_errors(run, model, fit, chunk)
    return Score(
        trial,
        (solution.beta_pa - plant.beta_pa) / solution.beta_sd_pa,
        solution.beta_pa / plant.beta_pa - 1,
        z,
        error,
        fit.lag_s - plant.lag_s,
        solution.rho,
    )


def grid(p_supply_pa: float) -> Grid:
    """The default grid of a simulated machine's user."""
    return default_grid(1.25 * p_supply_pa)


def block_errors(
    run: Run, model: Machine, fit: RecordFit, chunk: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean flow of every valid block beside the true flow averaged over the same intervals."""
    cells = assigned(model, fit, chunk)
    z, error, first = [], [], 0
    for i, edge in enumerate(model.edges):
        flow = run.truth.flow(edge.name)
        mean = 0.5 * (flow[1:] + flow[:-1])
        for block in fit.solution.blocks:
            if block.edge == i and block.status == VALID:
                here = cells[:, i] == first + block.i * edge.grid.shape[1] + block.j
                miss = block.mean_flow_m3s - float(mean[here].mean())
                z.append(miss / block.mean_sd_m3s)
                error.append(miss / np.abs(flow).max())
        first += edge.grid.shape[0] * edge.grid.shape[1]
    return np.array(z), np.array(error)


def assigned(model: Machine, fit: RecordFit, chunk: FloatArray) -> np.ndarray:
    """Grid cell of every edge over each interval, as the estimator assigned it (n - 1, edges)."""
    n, c = len(chunk), len(model.chambers)
    state = build(model, fit.weights)
    cells = np.empty((n - 1, len(model.edges)), np.int64)
    theta = np.zeros((len(state.cells), 6))
    flow, innovation = np.empty((n - 1, 2 * c)), np.empty((n - 1, c))
    explain(
        state.engine, state.cells, theta, fit.solution.compliance, chunk, flow, cells, innovation
    )
    return cells
