"""What the simulated machine is asked to do: references, dither, supply and load over time.

A motion is a function (plant, rng, duration_s) -> drive, float64 (n + 1, 6) at 1 kHz with the
columns of `rtid.sim.closed_loop`: x_ref, v_ref, dither, supply, tank, load force.  Where x_ref is
NaN the valves are shut.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rtid.plain import FloatArray
from rtid.sim.closed_loop import DITHER, LOAD, P_SUPPLY, P_TANK, V_REF, X_REF
from rtid.sim.simulated_plant import SimulatedPlant

DT_S = 1e-3
LOAD_SHARE = 700 / 4500  # of each varying load force in the load of the boom
# shares of a record: end of one, start of the other
IDENTIFICATION, VALIDATION = 80 / 110, 83 / 110
PUSH_SHARE, PUSH_LOAD_SHARE = 0.25, 0.4  # of the time; of the load of the boom
PUSH_S, PUSH_RAMP_S = 1.5, 0.05
BRAKE_S = 0.6
Motion = Callable[[SimulatedPlant, np.random.Generator, float], FloatArray]


def standstill(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """Hold the middle of the stroke at constant supply and load: drive (n + 1, 6), SI."""
    drive = np.zeros((round(duration_s / DT_S) + 1, 6))
    drive[:, X_REF] = 0.5 * plant.constants.stroke_m
    drive[:, P_SUPPLY] = plant.p_supply_pa
    drive[:, P_TANK] = plant.p_tank_pa
    return drive


def swept_sine(
    plant: SimulatedPlant,
    rng: np.random.Generator,
    duration_s: float,
    amplitude_m: float = 0.065,
    band_hz: tuple[float, float] = (0.1, 0.5),
) -> FloatArray:
    """The paper's reference: a sine that rises linearly through the band; drive (n + 1, 6), SI."""
    drive = standstill(plant, rng, duration_s)
    t = _time_s(drive)
    low, high = band_hz
    slope = (high - low) / max(duration_s, DT_S)
    phase = 2 * np.pi * (low * t + 0.5 * slope * t**2)
    drive[:, X_REF] += amplitude_m * np.sin(phase)
    drive[:, V_REF] = amplitude_m * 2 * np.pi * (low + slope * t) * np.cos(phase)
    return drive


def rich(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """The swept sine with steps of the command, a wandering supply and load: drive (n + 1, 6), SI.

    Command steps of +-0.3 / 0.6 V held 0.12 s, supply +-21 % slower than 0.1 Hz, four load forces
    between 0.07 and 1.7 Hz of 700 N each for the default machine, in proportion to its load.
    """
    return _everything(plant, rng, swept_sine(plant, rng, duration_s))


def dither(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """The swept sine with steps of the command alone: drive (n + 1, 6), SI."""
    return _with_steps(rng, swept_sine(plant, rng, duration_s))


def supply(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """The swept sine with a wandering supply alone: drive (n + 1, 6), SI."""
    return _with_supply(rng, swept_sine(plant, rng, duration_s))


def load(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """The swept sine with a varying load alone: drive (n + 1, 6), SI."""
    return _with_load(plant, rng, swept_sine(plant, rng, duration_s))


def push(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """A quarter of the time load steps against shut valves in mid-stroke, then the swept sine.

    The steps are too small for the controller to open a valve: the oil is compressed and leaks.
    Returns the drive (n + 1, 6), SI.
    """
    still = standstill(plant, rng, PUSH_SHARE * duration_s)[:-1]
    t = _time_s(still)
    steps = rng.choice([-1.0, -0.5, 0.5, 1.0], size=int(duration_s / PUSH_S) + 2)
    steps[0] = 0.0
    row, ramp = (t / PUSH_S).astype(int), np.minimum((t % PUSH_S) / PUSH_RAMP_S, 1.0)
    before = np.concatenate([[0.0], steps])[row]
    share = before + (steps[row] - before) * ramp
    still[:, LOAD] = PUSH_LOAD_SHARE * plant.constants.gravity_n * share
    rows = round(duration_s / DT_S) + 1
    rest_s = (rows - len(still) - 1) * DT_S
    return np.concatenate([still, swept_sine(plant, rng, rest_s)])


def sweep_record(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """A rig's record: swept sine, hold, random moves to be judged by; drive (n + 1, 6), SI."""
    return _record(plant, rng, duration_s)


def rich_record(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """The same with steps of the command while learning, wandering supply, varying load.

    The load varies half as much while the machine moves from point to point: it would cavitate.
    Returns the drive (n + 1, 6), SI.
    """
    drive = _everything(plant, rng, _record(plant, rng, duration_s))
    drive[round(IDENTIFICATION * duration_s / DT_S) :, DITHER] = 0.0
    share = np.linspace(0, 1, len(drive))
    drive[:, LOAD] *= np.interp(share, [IDENTIFICATION, VALIDATION], [1.0, 0.5])
    return drive


def moves(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """Random moves of fifth order, at most 0.2 m/s, with pauses between: drive (n + 1, 6)."""
    drive = standstill(plant, rng, duration_s)
    _write_moves(plant, rng, drive)
    return drive


def _write_moves(plant: SimulatedPlant, rng: np.random.Generator, drive: FloatArray) -> None:
    """Moves from the first reference on, written in place."""
    start, x = 0, drive[0, X_REF]
    while start < len(drive):
        target = 0.5 * plant.constants.stroke_m + rng.uniform(-0.09, 0.09)
        speed_mps = rng.uniform(0.05, 0.2)  # at mid-way: 15/8 of the mean speed
        steps = max(round(1.875 * abs(target - x) / speed_mps / DT_S), 200)
        _move(drive[start : start + steps], x, target, steps)
        drive[start + steps :, X_REF] = x = target
        start += steps + round(rng.uniform(0.2, 1.0) / DT_S)


MOTIONS: dict[str, Motion] = {
    "sweep": swept_sine,
    "rich": rich,
    "moves": moves,
    "standstill": standstill,
    "dither": dither,
    "supply": supply,
    "load": load,
    "push": push,
    "sweep_record": sweep_record,
    "rich_record": rich_record,
}
RECORDS = ("sweep_record", "rich_record")


def usual_duration_s(motion: str) -> float:
    """80 s, and 110 s for a record with its validation part."""
    return 110.0 if motion in RECORDS else 80.0


def parts_s(motion: str, duration_s: float) -> dict[str, tuple[float, float]]:
    """Spans of a run to learn from and to be judged by, s."""
    end, start = (IDENTIFICATION, VALIDATION) if motion in RECORDS else (0.75, 0.75)
    return {
        "identification_s": (0.0, end * duration_s),
        "validation_s": (start * duration_s, duration_s),
    }


def _record(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """Swept sine, brake within 0.6 s, hold, moves from there."""
    drive = standstill(plant, rng, duration_s)
    learn = swept_sine(plant, rng, IDENTIFICATION * duration_s)
    drive[: len(learn)] = learn
    rest, validation = drive[len(learn) :], drive[round(VALIDATION * duration_s / DT_S) :]
    s = np.minimum(_time_s(rest) / BRAKE_S, 1.0)
    rest[:, V_REF] = learn[-1, V_REF] * (1 - s) ** 2 * (1 + 2 * s)
    rest[:, X_REF] = learn[-1, X_REF] + DT_S * np.cumsum(rest[:, V_REF])
    _write_moves(plant, rng, validation)
    return drive


def _everything(plant: SimulatedPlant, rng: np.random.Generator, drive: FloatArray) -> FloatArray:
    return _with_load(plant, rng, _with_supply(rng, _with_steps(rng, drive)))


def _with_steps(rng: np.random.Generator, drive: FloatArray) -> FloatArray:
    """Command steps of +-0.3 / 0.6 V held 0.12 s, written in place."""
    duration_s = (len(drive) - 1) * DT_S
    steps = rng.choice([-0.6, -0.3, 0.3, 0.6], size=int(duration_s / 0.12) + 2)
    drive[:, DITHER] = steps[(_time_s(drive) / 0.12).astype(int)]
    return drive


def _with_supply(rng: np.random.Generator, drive: FloatArray) -> FloatArray:
    """Supply +-21 % slower than 0.1 Hz, written in place."""
    swing = _sines(_time_s(drive), rng, np.array([0.023, 0.061]), np.array([0.14, 0.07]))
    drive[:, P_SUPPLY] *= 1.0 + swing
    return drive


def _with_load(plant: SimulatedPlant, rng: np.random.Generator, drive: FloatArray) -> FloatArray:
    """Four load forces between 0.07 and 1.7 Hz, written in place."""
    edges = np.geomspace(0.07, 1.7, 5)
    rates_hz = rng.uniform(edges[:-1], edges[1:])
    force_n = np.full(4, LOAD_SHARE * plant.constants.gravity_n)
    drive[:, LOAD] = _sines(_time_s(drive), rng, rates_hz, force_n)
    return drive


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
