"""Fault 20 to its end: what is learned through clock steps and drift is what is learned without."""

from __future__ import annotations

import numpy as np

from benchmarks.frames import assembler
from firmware_bridge.catalog import load
from firmware_bridge.frames import Frames
from firmware_bridge.stamps import StampModel
from rtid.estimator.estimator import Estimator
from rtid.estimator.solution import Solution
from rtid.model import Machine
from rtid.sim.bus import run_frames
from rtid.sim.declare import declared_model, uniform_grid
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant

START_US = 1_700_000_000_000_000
HOUR_US = 3_600_000_000
STEPS = ((10, HOUR_US), (20, -HOUR_US), (25, -200_000))


def learned(frames: Frames, model: Machine) -> tuple[Solution, dict[str, int]]:
    bridge, estimator = assembler(), Estimator(model)
    estimator.update(bridge.push(frames))
    estimator.update(bridge.finish())
    return estimator.solution(), bridge.counters


def map_change(a: Solution, b: Solution) -> float:
    """Relative L2 change of the flow where each block was visited on average."""
    pairs = [(x, b.block(x.edge, x.i, x.j)) for x in a.blocks if x.status == "valid"]
    flows = np.array([(x.mean_phi @ x.theta, x.mean_phi @ y.theta, x.rows) for x, y in pairs if y])
    assert len(flows) == len(pairs) > 20
    weight = flows[:, 2]
    return float(np.sqrt(weight @ (flows[:, 0] - flows[:, 1]) ** 2 / (weight @ flows[:, 0] ** 2)))


def test_the_maps_change_by_less_than_02_per_cent() -> None:
    model = declared_model(SimulatedPlant(), grid=uniform_grid((1.0, 10.0, 10), (-0.5e6, 9.5e6, 8)))
    frames = run_frames(
        simulate(SimulatedPlant(), "sweep", seed=1, duration_s=30.0), load(), START_US
    )
    true_us = frames.t_us.copy()
    without, _ = learned(frames, model)
    frames.t_us[:] = START_US + np.rint((true_us - START_US) * (1 - 200e-6)).astype(np.int64)
    for at_s, by_us in STEPS:
        frames.t_us[true_us >= START_US + 1e6 * at_s] += by_us
    late_us = np.random.default_rng(0).integers(0, 1000, len(frames))
    mapped = StampModel().push(frames, np.maximum.accumulate(true_us + late_us))
    with_faults, counters = learned(mapped, model)
    assert counters["clock_step"] == counters["gap"] == len(STEPS)
    assert map_change(without, with_faults) <= 0.002
    np.testing.assert_allclose(with_faults.beta_pa, without.beta_pa, rtol=0.01)
