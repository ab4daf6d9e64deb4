"""What the simulated machine is asked to do: references, dither, supply and load over time.

A motion is a function (plant, rng, duration_s) -> drive, float64 (n + 1, 6) at 1 kHz with the
columns of `rtid.sim.loop`: x_ref, v_ref, dither, supply, tank, load force.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rtid.sim.loop import DITHER, LOAD, P_SUPPLY, P_TANK, V_REF, X_REF
from rtid.sim.plant import FloatArray, Plant

DT_S = 1e-3
LOAD_SHARE = 700 / 4500  # of each varying load force in the load of the boom
Motion = Callable[[Plant, np.random.Generator, float], FloatArray]


def standstill(plant: Plant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """Hold the middle of the stroke at constant supply and load."""
    drive = np.zeros((round(duration_s / DT_S) + 1, 6))
    drive[:, X_REF] = 0.5 * plant.constants.stroke_m
    drive[:, P_SUPPLY] = plant.p_supply_pa
    drive[:, P_TANK] = plant.p_tank_pa
    return drive


def swept_sine(
    plant: Plant,
    rng: np.random.Generator,
    duration_s: float,
    amplitude_m: float = 0.065,
    band_hz: tuple[float, float] = (0.1, 0.5),
) -> FloatArray:
    """The paper's reference: a sine whose frequency rises linearly through the band."""
    drive = standstill(plant, rng, duration_s)
    t = _time_s(drive)
    low, high = band_hz
    slope = (high - low) / max(duration_s, DT_S)
    phase = 2 * np.pi * (low * t + 0.5 * slope * t**2)
    drive[:, X_REF] += amplitude_m * np.sin(phase)
    drive[:, V_REF] = amplitude_m * 2 * np.pi * (low + slope * t) * np.cos(phase)
    return drive


def rich(plant: Plant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """The swept sine with steps of the command, a wandering supply and a varying load.

    Command steps of +-0.3 / 0.6 V held 0.12 s, supply +-21 % slower than 0.1 Hz, four load forces
    between 0.07 and 1.7 Hz of 700 N each for the default machine, in proportion to its load.
    """
    drive = swept_sine(plant, rng, duration_s)
    t = _time_s(drive)
    steps = rng.choice([-0.6, -0.3, 0.3, 0.6], size=int(duration_s / 0.12) + 2)
    drive[:, DITHER] = steps[(t / 0.12).astype(int)]
    swing = _sines(t, rng, np.array([0.023, 0.061]), np.array([0.14, 0.07]))
    drive[:, P_SUPPLY] *= 1.0 + swing
    edges = np.geomspace(0.07, 1.7, 5)
    rates_hz = rng.uniform(edges[:-1], edges[1:])
    drive[:, LOAD] = _sines(t, rng, rates_hz, np.full(4, LOAD_SHARE * plant.constants.gravity_n))
    return drive


def moves(plant: Plant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """Random point-to-point moves, fifth-order in time, at most 0.2 m/s, with pauses between."""
    drive = standstill(plant, rng, duration_s)
    start, x = 0, drive[0, X_REF]
    while start < len(drive):
        target = 0.5 * plant.constants.stroke_m + rng.uniform(-0.09, 0.09)
        speed_mps = rng.uniform(0.05, 0.2)  # at mid-way: 15/8 of the mean speed
        steps = max(round(1.875 * abs(target - x) / speed_mps / DT_S), 200)
        _move(drive[start : start + steps], x, target, steps)
        drive[start + steps :, X_REF] = x = target
        start += steps + round(rng.uniform(0.2, 1.0) / DT_S)
    return drive


MOTIONS: dict[str, Motion] = {
    "sweep": swept_sine,
    "rich": rich,
    "moves": moves,
    "standstill": standstill,
}


def _time_s(drive: FloatArray) -> FloatArray:
    return DT_S * np.arange(len(drive), dtype=np.float64)


def _sines(
    t_s: FloatArray, rng: np.random.Generator, rates_hz: FloatArray, amplitudes: FloatArray
) -> FloatArray:
    """Sum of sines with random phases, float64 as t_s."""
    phases = rng.uniform(0, 2 * np.pi, size=len(rates_hz))
    turns = np.outer(t_s, rates_hz)
    total: FloatArray = np.sin(2 * np.pi * turns + phases) @ amplitudes
    return total


def _move(drive: FloatArray, start_m: float, target_m: float, steps: int) -> None:
    """Write one minimum-jerk move of `steps` samples into the (possibly shorter) rows in place."""
    s = np.arange(len(drive)) / steps
    drive[:, X_REF] = start_m + (target_m - start_m) * s**3 * (10 - 15 * s + 6 * s**2)
    drive[:, V_REF] = (target_m - start_m) * 30 * s**2 * (1 - s) ** 2 / (steps * DT_S)
