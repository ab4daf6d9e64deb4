"""A boom on a programmable valve: five valves with a command each, driven under its data sheet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rtid.model import Grid, Machine
from rtid.plain import FloatArray
from rtid.sim.boom import boom, write_boom
from rtid.sim.boom_references import swept
from rtid.sim.bus import tracked_frames
from rtid.sim.declare import declared_model
from rtid.sim.robust import Flow, Knowledge, Tracked, run, sampled
from rtid.sim.run import SimulationError
from rtid.sim.run_files import START_US
from rtid.sim.simulated_plant import EDGES, SimulatedPlant

GAIN_ERROR, DEADBAND_ERROR_V = 0.1, 0.3
DP_STEP_PA = 0.5e6


def five_valves(number: int) -> SimulatedPlant:
    """The random boom with this number; each valve opens with a positive command of its own."""
    return replace(boom(number), directions=(1,) * len(EDGES))


def declared(plant: SimulatedPlant, seed: int) -> Machine:
    """What its user declares: unknown maps, fine where the dead band may end."""
    fine, coarse = np.linspace(1.0, 4.0, 13), np.linspace(4.0, 10.0, 13)[1:]
    drops = np.linspace(0.0, 9e6, round(9e6 / DP_STEP_PA) + 1)
    grid = Grid(np.concatenate([fine, coarse]), drops)
    return declared_model(plant, grid=grid, seed=seed, one_by_one=True)


def manufacturer(plant: SimulatedPlant, number: int) -> Flow:
    """What a data sheet says: each valve up to 10 % of gain and 0.3 V of dead band wrong."""
    rng = np.random.default_rng([number, 6])
    four = len(EDGES) - 1  # the cross-port valve is drawn last
    gain = rng.uniform(1 - GAIN_ERROR, 1 + GAIN_ERROR, four)
    shift_v = rng.uniform(-DEADBAND_ERROR_V, DEADBAND_ERROR_V, four)
    gain = np.append(gain, rng.uniform(1 - GAIN_ERROR, 1 + GAIN_ERROR))
    shift_v = np.append(shift_v, rng.uniform(-DEADBAND_ERROR_V, DEADBAND_ERROR_V))

    def flow(edge: str, w: FloatArray, dp: FloatArray) -> FloatArray:
        k = EDGES.index(edge)
        return np.asarray(gain[k] * plant.flow(edge, w - shift_v[k], dp))

    return flow


def record_sweep(trace: Path, plant: SimulatedPlant, number: int) -> list[Path]:
    """Write the first sweep of a commissioning and its project file.  Raises SimulationError."""
    reference, known = swept(plant), Knowledge(sampled(manufacturer(plant, number)))
    tracked = run(plant, known, reference, number)
    if fault := lost(plant, tracked, reference):
        raise SimulationError(fault)
    frames = tracked_frames(tracked, reference, START_US)
    return [trace, write_boom(trace, plant, declared(plant, number), frames)]


def lost(plant: SimulatedPlant, tracked: Tracked, reference: FloatArray) -> str:
    """In what way a boom got lost on a reference (n, 4) in SI, empty if it did not."""
    x = tracked.error_m + reference[:, 0]
    if not ((x > 0) & (x < plant.constants.stroke_m)).all():
        return "the boom leaves its stroke"
    return "" if (tracked.true_pa > 1e4).all() else "the boom cavitates"
