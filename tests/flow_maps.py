"""Made-up solutions for the tests of maps: blocks that have seen a known flow with noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rtid.estimator.blocks import LEARNING, VALID, Block
from rtid.estimator.solution import Solution, solve
from rtid.estimator.state import build
from rtid.model import COMMAND, POSITION, PRESSURE, Chamber, Edge, Grid, Machine, Signal
from rtid.plain import FloatArray

Flow = Callable[[FloatArray, FloatArray], FloatArray]
RATED_Q_M3S, RATED_DP_PA = 3e-4, 3e6
GRID = Grid(
    np.concatenate([np.arange(1.0, 4.0, 0.25), np.arange(4.0, 8.1, 0.5)]),
    np.array([-0.5, 0.0, 0.25, 0.5, 1.0, 1.75, 2.5, 3.25, 4.0, 4.75, 5.5, 6.25, 7.0]) * 1e6,
)


def orifice(w_v: FloatArray, dp_pa: FloatArray) -> FloatArray:
    """Dead band of 1.8 V, then a slightly curved gain; Q = K(w) sqrt(dp)."""
    above = np.maximum(w_v - 1.8, 0.0)
    gain = 2.5e-8 * (above + 0.05 * above**2)
    return np.asarray(gain * np.sign(dp_pa) * np.sqrt(np.abs(dp_pa)))


def compensated(w_v: FloatArray, dp_pa: FloatArray) -> FloatArray:
    """A load-compensated valve: its flow hardly depends on the pressure drop."""
    above = np.maximum(w_v - 1.8, 0.0)
    return np.asarray(5e-5 * above * np.sign(dp_pa) * np.abs(dp_pa / 3e6) ** 0.15)


def machine(grid: Grid = GRID, safe_band_v: float = 1.0, edges: int = 1) -> Machine:
    """One chamber, fed by edges that are all alike."""
    signals = (
        Signal("u", COMMAND),
        Signal("p_s", PRESSURE, noise=5e3),
        Signal("p_a", PRESSURE, noise=5e3),
        Signal("x", POSITION, noise=1e-5),
    )
    edge = (grid, safe_band_v, RATED_Q_M3S, RATED_DP_PA)
    return Machine(
        signals,
        (Chamber("a", "p_a", 2e-3, 1, 6e-4),),
        tuple(Edge(f"e{i}", "p_s", "p_a", "u", 1, *edge) for i in range(edges)),
        "x",
        8e8,
        (2e8, 1.6e9),
    )


def solved(
    model: Machine,
    flow: Flow,
    rng: np.random.Generator,
    *,
    path: int = 3,
    rows: int = 400,
    noise_m3s: float = 2e-6,
) -> Solution:
    """Blocks along `path` random bands of the plane, each fitted to noisy samples of flow."""
    blocks = []
    for e, edge in enumerate(model.edges):
        for i, j in sorted(_visited(edge.grid, rng, path)):
            blocks.append(_block(edge, e, i, j, flow, rng, rows, noise_m3s))
    return replace(empty(model), blocks=tuple(blocks))


def empty(model: Machine) -> Solution:
    """What is known before the first sample."""
    return solve(model, build(model))


def _visited(grid: Grid, rng: np.random.Generator, path: int) -> set[tuple[int, int]]:
    nu, nd = grid.shape
    cells = set()
    for _ in range(path):
        t = np.linspace(0, 1, 200)
        w = grid.u_v[0] + (rng.uniform(0.5, 0.8) * t) * (grid.u_v[-1] - grid.u_v[0])
        start, end = rng.uniform(1e6, 6e6, 2)
        i = np.clip(np.searchsorted(grid.u_v, w) - 1, 0, nu - 1)
        j = np.searchsorted(grid.dp_pa, start + (end - start) * t) - 1
        cells |= set(zip(i.tolist(), np.clip(j, 0, nd - 1).tolist(), strict=True))
    return cells


def _block(
    edge: Edge,
    e: int,
    i: int,
    j: int,
    flow: Flow,
    rng: np.random.Generator,
    rows: int,
    noise_m3s: float,
) -> Block:
    u, p = edge.grid.u_v[i : i + 2], edge.grid.dp_pa[j : j + 2]
    xi = np.clip(rng.uniform(-0.7, 0.7) + 0.4 * rng.standard_normal(rows), -1, 1)
    eta = np.clip(rng.uniform(-0.7, 0.7) + 0.4 * rng.standard_normal(rows), -1, 1)
    phi = np.stack([np.ones(rows), xi, eta, xi * xi, eta * eta, xi * eta], axis=1)
    w, dp = u.mean() + 0.5 * np.diff(u) * xi, p.mean() + 0.5 * np.diff(p) * eta
    q = flow(w, dp) + noise_m3s * rng.standard_normal(rows)
    gram = phi.T @ phi + np.eye(6) * (noise_m3s / (10 * edge.rated_q_m3s)) ** 2
    cov = np.asarray(np.linalg.inv(gram) * noise_m3s**2, np.float64)
    theta = np.asarray(np.linalg.solve(gram, phi.T @ q), np.float64)
    sure = rows >= 100
    status, reason = (VALID, "") if sure else (LEARNING, f"{rows} rows, 100 needed")
    return Block(
        e, i, j, theta, cov, phi.mean(axis=0), rows, rows * 1e-3, 1.0, 100.0, status, reason
    )
