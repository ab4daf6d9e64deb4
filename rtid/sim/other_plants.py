"""Plants that are no hydraulic machine, as tables for `rtid refit`: a drive, a heated room.

    drive   w' = b tanh(c u) - a w                                     hidden: friction, sticking
    room    T' = p u - c (T - W),  W' = c/10 (T - W) - g (W - T_out)    hidden: an open window

Simulated in another form than a refit integrates them: fine Euler steps, and true sticking.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from shutil import copy

import numpy as np

from rtid.errors import RtidError
from rtid.plain import FloatArray

FINE = 20  # steps per sample
PLANT_FILES = Path(__file__).parents[1] / "project" / "examples"


@dataclass(frozen=True)
class Recorded:
    """A record: columns (n,) by name, and the true size of what is hidden, in its unit."""

    columns: dict[str, FloatArray]
    hidden: str
    size: float
    unit: str


def drive(rng: np.random.Generator, hide: bool) -> Recorded:
    """An electric drive behind an amplifier that saturates softly; friction that sticks."""
    n, dt_s = 800, 0.01
    a, b, c = rng.uniform(2, 5), rng.uniform(200, 320), rng.uniform(0.2, 0.35)
    u = steps(rng, -6, 6, 40, n) * np.where(steps(rng, 0, 1, 40, n) < 0.3, 0.25, 1.0)
    friction = float(rng.uniform(15, 40)) if hide else 0.0

    def step(w: FloatArray, k: int, h: float) -> FloatArray:
        w = w + h * (b * np.tanh(c * u[k]) - a * w)
        return np.asarray(w - np.sign(w) * np.minimum(np.abs(w), h * friction))

    w = moved(step, np.zeros(1), n, dt_s)[:, 0]
    y = w + 0.1 * rng.standard_normal(n)
    columns = {"t_s": np.asarray(dt_s * np.arange(n)), "u_v": u, "w_rad_s": y}
    return Recorded(columns, "coulomb_friction:w", friction, "rad/s2")


def room(rng: np.random.Generator, hide: bool) -> Recorded:
    """A heated room and its wall, which nobody measures; the weather is known."""
    n, dt_s = 900, 120.0
    p, c, g = rng.uniform(2e-3, 4e-3), rng.uniform(2e-4, 4e-4), rng.uniform(3e-5, 6e-5)
    t_s, u = dt_s * np.arange(n), steps(rng, 0, 1, 60, n)
    outside = 5 + 6 * np.sin(2 * np.pi * t_s / 86_400) + 2 * np.sin(2 * np.pi * t_s / 30_000)
    loss = float(rng.uniform(2e-5, 6e-5)) if hide else 0.0

    def step(x: FloatArray, k: int, h: float) -> FloatArray:
        out = 0.5 * (outside[k] + outside[min(k + 1, n - 1)])
        air, wall = x
        warmer = p * u[k] - c * (air - wall) - loss * (air - out)
        return np.array([air + h * warmer, wall + h * (0.1 * c * (air - wall) - g * (wall - out))])

    air = moved(step, np.array([18.0, 15.0]), n, dt_s)[:, 0]
    y = air + 0.02 * rng.standard_normal(n)
    columns = {"t_s": t_s, "heating": u, "outside_c": outside, "inside_c": y}
    return Recorded(columns, "heat_loss:T", loss, "1/s")


EXAMPLES: dict[str, Callable[[np.random.Generator, bool], Recorded]] = {
    "electric_drive": drive,
    "heated_room": room,
}


def write_example(name: str, table: Path, seed: int, hide: bool) -> tuple[Recorded, list[Path]]:
    """Write a record as CSV with its plant file beside it; raises RtidError for another name."""
    if name not in EXAMPLES:
        raise RtidError(f"--example {name}: unknown", f"use one of {', '.join(EXAMPLES)}", 2)
    if table.suffix != ".csv" or not table.parent.is_dir():
        raise RtidError(
            f"{table}: cannot be written", "name a .csv file in a folder that exists", 2
        )
    recorded = EXAMPLES[name](np.random.default_rng(seed), hide)
    values = np.column_stack(list(recorded.columns.values()))
    np.savetxt(table, values, "%.9g", ",", header=",".join(recorded.columns), comments="")
    plant = Path(copy(PLANT_FILES / f"{name}.toml", table.with_suffix(".toml")))
    return recorded, [table, plant]


def steps(rng: np.random.Generator, low: float, high: float, each: int, n: int) -> FloatArray:
    """An input (n,), any SI unit, that is drawn anew between low and high every so many samples."""
    return np.repeat(rng.uniform(low, high, n // each + 1), each)[:n]


def moved(
    step: Callable[[FloatArray, int, float], FloatArray],
    start: FloatArray,
    n: int,
    dt_s: float,
    fine: int = FINE,
) -> FloatArray:
    """States (n, states); step(x, k, h) makes one of the `fine` steps in interval k."""
    x, states = start, np.empty((n, len(start)))
    for k in range(n):
        states[k] = x
        for _ in range(fine):
            x = step(x, k, dt_s / fine)
    return states
