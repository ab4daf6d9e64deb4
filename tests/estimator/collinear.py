"""Records whose first rows are nearly collinear: the command hardly moves, the pressures creep.

Two seconds of a slow steady stroke, then rich motion.  What is started from the first n rows

    P_0 = (Phi_n' Phi_n)^-1,   theta_0 = P_0 Phi_n' y_n

keeps the error of that inverse; sums do not care in which order the rows come.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.estimator.chunk import to_chunk
from rtid.model import Filter, Grid
from rtid.plain import FloatArray
from rtid.sim.closed_loop import DITHER, LOAD, V_REF, X_REF
from rtid.sim.declare import declared_model
from rtid.sim.demand import DT_S, rich
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.estimator.cases import Case
from tests.estimator.rivals import Recursion, unknown

SETTLE_S, CREEP_S, CREEP_MPS = 1.0, 2.0, 0.02
GRID = Grid(np.array([1.0, 2.0, 3.0, 4.5, 10.0]), np.array([-1.0, 1.0, 2.5, 4.0, 6.0, 10.0]) * 1e6)


def creeping_start(
    plant: SimulatedPlant, rng: np.random.Generator, duration_s: float
) -> FloatArray:
    """Steady stroke at constant supply and load, then the rich motion from where it is."""
    drive = rich(plant, rng, duration_s)
    first = round((SETTLE_S + CREEP_S) / DT_S)
    moving = drive[: len(drive) - first].copy()
    calm = np.repeat(moving[:1], first, axis=0)
    t = DT_S * np.arange(first)
    calm[:, DITHER] = 0.0
    calm[:, LOAD] *= np.cos(2 * np.pi * 0.5 * (t[-1] - t))
    calm[:, V_REF] = CREEP_MPS
    calm[:, X_REF] -= CREEP_MPS * (t[-1] - t)
    return np.concatenate([calm, moving])


def record(seed: int, rich_s: float) -> Case:
    """The record from the moment on at which the stroke is steady."""
    plant = draw(seed)
    run = simulate(plant, creeping_start, seed, SETTLE_S + CREEP_S + rich_s)
    model = replace(declared_model(plant, grid=GRID), filter=Filter(rows_per_s=100.0))
    chunk = to_chunk(model, run.samples, 0)[round(SETTLE_S / DT_S) :]
    return Case(model, chunk[:, 0], chunk[:, 2:], chunk[:, 1])


def condition(rows: FloatArray) -> float:
    """Condition number of Phi'Phi, columns in units of their own size."""
    size = np.linalg.norm(rows, axis=0)
    return float(np.linalg.cond(rows / np.where(size > 0, size, 1.0)) ** 2)


def error_at_the_end(rival: type[Recursion], rows: FloatArray, first: int) -> float:
    """Error against batch least squares, in units of its largest parameter.

    rows (n, 8), y last; first: number of rows that the recursion is started from, 0: from nothing.
    """
    phi, y = rows[:, :-1], rows[:, -1]
    batch = np.linalg.lstsq(phi, y, rcond=None)[0]
    recursion = rival(*(_inverted(phi[:first], y[:first]) if first else unknown()))
    for row in rows[first:]:
        recursion.take(row[:-1], row[-1])
    return float(np.abs(recursion.theta - batch).max() / np.abs(batch).max())


def _inverted(phi: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """theta_0 and P_0 of these rows, P_0 made symmetric again: the recursions want it so."""
    inverse = np.linalg.inv(phi.T @ phi)
    P = np.asarray(0.5 * (inverse + inverse.T))
    return P @ (phi.T @ y), P
