"""A machine that stands against its stops with a valve open: what its sensors then say.

No flow but a leak passes: Q_in(p_supply - p_c) = C (p_c - p_d) = Q_out(p_d - p_tank), c the chamber
that is fed, d the other one.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from rtid.plain import FloatArray
from rtid.sim.run import Sensors
from rtid.sim.simulated_plant import SimulatedPlant

STEP_S = 1e-3


def against_the_stops(
    plant: SimulatedPlant,
    commands: tuple[tuple[float, float], ...],
    seed: int = 0,
    leak_m3spa: float = 0.0,
) -> FloatArray:
    """The samples' values (n, 7), SI, of each (u, seconds), with the sensors' noise and no bias.

    leak_m3spa: C, from one chamber to the other.
    """
    rows = []
    for u, seconds in commands:
        fed, other = _pressures(plant, u, leak_m3spa)
        a, b = (fed, other) if u > 0 else (other, fed)
        x = plant.constants.stroke_m if u > 0 else 0.0
        row = [u, a, b, plant.p_supply_pa, plant.p_tank_pa, x, 0.0]
        rows += [row] * round(seconds / STEP_S)
    sensors, rng = Sensors(), np.random.default_rng([seed, 77])
    values = np.array(rows)
    return sensors.quantise(values + rng.standard_normal(values.shape) * sensors.noise())


def _pressures(plant: SimulatedPlant, u: float, leak: float) -> tuple[float, float]:
    """Of the chamber that is fed and of the other one, Pa: by halving what leaks."""
    into, out = ("pa", "bt") if u > 0 else ("pb", "at")

    def drop(edge: str, q: float) -> float:
        if q == 0.0:
            return 0.0
        return float(brentq(lambda dp: float(plant.flow(edge, abs(u), dp)) - q, 0.0, 1e8))

    def ends(q: float) -> tuple[float, float]:
        return plant.p_supply_pa - drop(into, q), plant.p_tank_pa + drop(out, q)

    def excess(q: float) -> float:
        fed, other = ends(q)
        return q - leak * (fed - other)

    return ends(float(brentq(excess, 0.0, leak * plant.p_supply_pa)) if leak else 0.0)
