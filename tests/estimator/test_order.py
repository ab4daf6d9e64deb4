"""Noise-free data of a smooth machine: what is left is the basis' own error, of third order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.estimator.record import run
from rtid.estimator.solution import Solution, solve
from rtid.kernels.basis import taylor
from rtid.model import Gates, Lag
from rtid.sim.declare import declared_model, uniform_grid
from rtid.sim.run import EXACT, Sensors, simulate
from rtid.sim.simulated_plant import SimulatedPlant, smooth_plant

SLIGHT = Sensors(p_noise_pa=20.0, p_tank_noise_pa=4.0, x_noise_m=4e-8, quantised=False)
POINTS = [(xi, eta) for xi in (-0.5, 0.0, 0.5) for eta in (-0.5, 0.0, 0.5)]


def learned(plant: SimulatedPlant, chunk: np.ndarray, nu: int, nd: int) -> Solution:
    """The estimate on a grid of nu x nd blocks over 0..8 V and -1..9 MPa."""
    grid = uniform_grid((0.0, 8.0, nu), (-1e6, 9e6, nd))
    model = declared_model(plant, grid=grid, sensors=SLIGHT, safe_band_v=0.0)
    model = replace(model, lag=Lag(plant.lag_s, 0.0), gates=Gates(condition_limit=1e5))
    state = run(model, chunk)
    return solve(model, state)


def map_error(plant: SimulatedPlant, solution: Solution) -> float:
    """Rms error inside the well visited blocks above 2 MPa and 1 V, share of their rms flow."""
    errors, flows, terms = [], [], np.empty(6)
    for block in solution.blocks:
        edge = solution.model.edges[block.edge]
        u, dp = edge.grid.u_v[block.i : block.i + 2], edge.grid.dp_pa[block.j : block.j + 2]
        if block.status != "valid" or dp[0] < 2e6 or u[0] < 1.0 or block.condition > 1e4:
            continue
        for xi, eta in POINTS:
            taylor(xi, eta, terms)
            w, p = u.mean() + xi * np.diff(u)[0] / 2, dp.mean() + eta * np.diff(dp)[0] / 2
            true = float(plant.flow(edge.name, w, p))
            errors.append(terms @ block.theta - true)
            flows.append(true)
    assert len(errors) > 5 * len(POINTS)
    return float(np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(flows))))


def test_the_map_error_falls_with_the_third_power_of_the_block_size() -> None:
    plant = smooth_plant()
    samples = simulate(plant, "sweep", 1, 80.0, EXACT).samples
    chunk = np.column_stack([samples.t_us * 1e-6, samples.flags, samples.values])
    coarse, fine = learned(plant, chunk, 8, 10), learned(plant, chunk, 16, 20)
    slope = np.log2(map_error(plant, coarse) / map_error(plant, fine))
    assert 2.5 < slope < 3.5
    for solution in (coarse, fine):  # blocks of 1 V x 1 MPa and of half that size
        assert solution.beta_pa == pytest.approx(plant.beta_pa, rel=5e-3)
