"""References of a boom that commands each valve by itself: position and its derivatives to jerk.

Rows of x_d, v_d, a_d and jerk, SI, at 1 kHz, float64 (n, 4).
"""

from __future__ import annotations

import numpy as np

from rtid.plain import FloatArray
from rtid.sim.boom import MOST_OF_STROKE, SWEEP_S, TOP_HZ, TOP_V
from rtid.sim.demand import DT_S
from rtid.sim.simulated_plant import SimulatedPlant

LOW_HZ = 0.1
REACH = 0.8  # of what the sweep with one command does: here the low side carries less pressure
MOVE, SPEED = 0.8, 0.6  # of the sweep's stroke and of its highest speed
HOLD_S = 2.0


def amplitude_m(plant: SimulatedPlant) -> float:
    """Of the sweep, as far as valves and stroke allow."""
    k = plant.controller
    speed_mps = (TOP_V - k.deadband_v) / k.volts_per_mps
    return REACH * min(speed_mps / (2 * np.pi * TOP_HZ), MOST_OF_STROKE * plant.constants.stroke_m)


def swept(plant: SimulatedPlant, duration_s: float = SWEEP_S) -> FloatArray:
    """The paper's sweep (n, 4), SI, from rest at its lowest point: -cos of a phase as t^2."""
    t = np.arange(round(duration_s / DT_S)) * DT_S
    rise = 2 * np.pi * (TOP_HZ - LOW_HZ) / duration_s
    phase, rate = 2 * np.pi * LOW_HZ * t + 0.5 * rise * t**2, 2 * np.pi * LOW_HZ + rise * t
    sine, cosine = np.sin(phase), np.cos(phase)
    unit = [
        -cosine,
        rate * sine,
        rise * sine + rate**2 * cosine,
        3 * rate * rise * cosine - rate**3 * sine,
    ]
    whole = amplitude_m(plant) * np.stack(unit, axis=1)
    whole[:, 0] += 0.5 * plant.constants.stroke_m
    return whole


def point_to_point(plant: SimulatedPlant) -> FloatArray:
    """Hold, up, hold, down, hold (n, 4), SI: moves of fifth order, within what the sweep covers."""
    top_mps = SPEED * amplitude_m(plant) * 2 * np.pi * TOP_HZ
    way_m = 2 * MOVE * amplitude_m(plant)
    move_s = 1.875 * way_m / top_mps
    s = np.arange(round(move_s / DT_S)) * DT_S / move_s
    up = way_m * np.stack(
        [
            s**3 * (10 - 15 * s + 6 * s**2),
            30 * s**2 * (1 - s) ** 2 / move_s,
            (60 * s - 180 * s**2 + 120 * s**3) / move_s**2,
            (60 - 360 * s + 360 * s**2) / move_s**3,
        ],
        axis=1,
    )
    still, top = np.zeros((round(HOLD_S / DT_S), 4)), np.array([way_m, 0, 0, 0])
    whole = np.concatenate([still[: len(still) // 4], up, still + top, top - up, still])
    whole[:, 0] += 0.5 * (plant.constants.stroke_m - way_m)
    return whole
