"""A simulated run of a cylinder between valves as a case: one part teaches, the other judges.

Methods get what the sensors say of the first part; of the second they get the true signals, so
that what is judged is the model and not the noise on its inputs.  One unit of a pressure rate
counts V / beta over the rms flow of its chamber.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.missing.record import Case, Record, Truth
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.sim.declare import ENDS, declared_model, default_grid
from rtid.sim.demand import DT_S, IDENTIFICATION, VALIDATION
from rtid.sim.run import NAMES, Sensors
from rtid.sim.sensing import P_A, P_B, V, X
from rtid.sim.simulated_plant import EDGES, SimulatedPlant

RECORD_S = 44.0  # of which 32 s teach and 10.8 s judge
MEAN_OVER = 10  # samples: what a command step does within one is nobody's business
POINTS = 400  # of an edge's map
SAFE_V = 1.0


@dataclass(frozen=True)
class Simulated:
    """What any simulator gives: seen and true signals (n, 7), columns as `NAMES`, SI.

    opening_v (n, edges): behind the lag; flow: the true map.
    """

    plant: SimulatedPlant
    seen: FloatArray
    true: FloatArray
    opening_v: FloatArray
    flow: Callable[[str, ArrayLike, ArrayLike], FloatArray]


def case_of(simulated: Simulated, seed: int, effect: str, **words: str | bool) -> Case:
    """The case; words: its name, simulator, law, motion, hidden, level and for_all."""
    plant = simulated.plant
    machine = declared_model(plant, seed=seed, grid=default_grid(1.25 * plant.p_supply_pa))
    n = len(simulated.seen)
    taught, judged = round(IDENTIFICATION * n), round(VALIDATION * n)
    t_s = DT_S * np.arange(n, dtype=np.float64)
    train = Record(machine, t_s[:taught], simulated.seen[:taught])
    test = Record(machine, t_s[judged:], simulated.true[judged:])
    truth = _truth(simulated, taught, judged, machine, effect)
    return Case(train=train, test=test, truth=truth, **words)  # type: ignore[arg-type]


def noisy(true: FloatArray, seed: int, sensors: Sensors | None = None) -> FloatArray:
    """What sensors say of the true signals (n, 7), where a simulator has none of its own."""
    sensors = sensors or Sensors()
    rng = np.random.default_rng([seed, 3])
    return sensors.quantise(true + sensors.noise() * rng.standard_normal(true.shape))


def _truth(simulated: Simulated, taught: int, judged: int, machine: Machine, effect: str) -> Truth:
    plant, true = simulated.plant, simulated.true
    p, v = true[judged:, [P_A, P_B]], true[judged:, V]
    rate = np.diff(p, axis=0, append=p[-1:]) / DT_S
    volume = np.stack(
        [c.v0_m3 + c.sign * c.area_m2 * true[judged:, X] for c in machine.chambers], 1
    )
    moved = np.stack([c.area_m2 * v for c in machine.chambers], axis=1)
    scale = volume / plant.beta_pa / np.sqrt(np.mean(moved**2, axis=0))
    points = {e.name: _points(simulated, e.name, taught) for e in machine.edges}
    return Truth(rate, scale, MEAN_OVER, simulated.flow, points, plant.beta_pa, effect)


def _points(simulated: Simulated, edge: str, taught: int) -> tuple[FloatArray, FloatArray]:
    """Evenly picked working points (w, dp) of the part that teaches, where the edge is open."""
    w = simulated.opening_v[:taught, EDGES.index(edge)]
    high, low = (simulated.true[:taught, NAMES.index(end)] for end in ENDS[edge])
    at = np.flatnonzero(w > SAFE_V)
    at = at[:: max(1, len(at) // POINTS)]
    return w[at], (high - low)[at]
