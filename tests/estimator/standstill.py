"""A machine that moves for a minute and then stands still for hours: only sensor noise comes.

Three ways to stand: the valves shut; the supply valve of chamber A open by a hair, still inside its
overlap; or pressed against a stop with that valve open, the pressure drop about zero.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from rtid.estimator.chunk import to_chunk
from rtid.estimator.estimator import Estimator
from rtid.estimator.flowmap import VALID, FlowMap
from rtid.estimator.published import publish
from rtid.estimator.solution import Solution
from rtid.kernels.layout import TERMS
from rtid.model import Grid, Machine, Upkeep
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.random_plants import draw
from rtid.sim.run import P_A, P_B, P_S, P_T, Run, U, V, simulate
from rtid.sim.simulated_plant import PA
from tests.estimator.rivals import OneBlock, Recursion, unknown

WAYS = ("shut", "in the overlap", "against the stop")
SEED, MOTION_S, STEP_S = 5, 60.0, 0.01
PIECE_S = 60.0  # of the standstill, made at a time
COARSE = Grid(
    np.array([1.0, 2.0, 3.0, 4.5, 10.0]), np.array([-0.3, 0.3, 1.0, 2.5, 4.0, 6.0, 10.0]) * 1e6
)


@dataclass(frozen=True)
class Standstill:
    """What is left after it: drift and lowest are those of the valid blocks.

    drift: change of the published map, relative L2; lowest: smallest eigenvalue of the scaled
    information; finite: all sums and the published map; beta_drift (chambers,): relative, and in
    units of the standard deviation before; blocks: that were valid.
    """

    drift: float
    beta_drift: FloatArray
    beta_drift_sd: FloatArray
    lowest: float
    finite: bool
    blocks: int
    samples: int

    def __str__(self) -> str:
        beta, sd = np.abs(self.beta_drift).max(), np.abs(self.beta_drift_sd).max()
        state = "definite" if self.lowest > 0 else "NOT definite"
        return (
            f"{state} ({self.lowest:.0e}), map {100 * self.drift:.3f} % over {self.blocks} blocks, "
            f"beta {100 * beta:.3f} % ({sd:.1f} sd)"
        )


@cache
def motion() -> Run:
    """A minute of rich motion."""
    return simulate(draw(SEED), "rich", SEED, MOTION_S)


def forgetful(grid: Grid | None, forget_s: float) -> Machine:
    """The declaration, with the time constant of blocks and shared unknowns; grid: the default."""
    upkeep = Upkeep(every_s=60.0, forget_s=forget_s, shared_forget_s=forget_s)
    return replace(declared_model(motion().plant, grid=grid), upkeep=upkeep)


def standing(run: Run, way: str, duration_s: float) -> Iterator[FloatArray]:
    """Chunks of PIECE_S at 100 Hz from the last true state on, after a gap of a second."""
    true, plant = run.truth.signals[-1].copy(), run.plant
    true[[U, V]] = 0.0
    if way == "in the overlap":
        true[U] = 1.05  # the safe band ends at 1 V, the valve's overlap later
    if way == "against the stop":
        true[U] = plant.valves[PA].deadband_v + 0.3
        true[[P_A, P_B]] = true[[P_S, P_T]]
    rng, n = np.random.default_rng(9), round(PIECE_S / STEP_S)
    start_s = MOTION_S + 1.0
    for _ in range(round(duration_s / PIECE_S)):
        values = true + run.sensors.noise() * rng.standard_normal((n, len(true)))
        values = _quantised(values, run.sensors.resolution())
        yield np.column_stack([start_s + STEP_S * np.arange(n), np.ones(n), values])
        start_s += PIECE_S


def _quantised(values: FloatArray, step: FloatArray) -> FloatArray:
    fine = np.where(step > 0, step, 1.0)
    return np.where(step > 0, fine * np.floor(values / fine + 0.5), values)


def stand(way: str, duration_s: float, forget_s: float, grid: Grid | None) -> Standstill:
    """Learn, stand, and compare."""
    model, run = forgetful(grid, forget_s), motion()
    estimator = Estimator(model)
    estimator.advance(to_chunk(model, run.samples, 0))
    before = estimator.solution()
    for chunk in standing(run, way, duration_s):
        estimator.advance(chunk)
    after = estimator.solution()
    maps, normal = (publish(before), publish(after)), estimator.sums.normal()
    beta = after.beta_pa - before.beta_pa
    finite = (normal.gram, normal.right, maps[1].theta_cells(), after.compliance_cov)
    return Standstill(
        drift(*maps),
        beta / before.beta_pa,
        beta / before.beta_sd_pa,
        _lowest(normal.gram, before, after),
        all(bool(np.isfinite(a).all()) for a in finite),
        sum(block.status == VALID for block in before.blocks),
        estimator.counters["samples"],
    )


def drift(before: FlowMap, after: FlowMap) -> float:
    """Change of the published flow over the blocks that were valid, relative L2."""
    change, size = 0.0, 0.0
    for old, new in zip(before.edges, after.edges, strict=True):
        i, j = np.nonzero(old.status == VALID)
        u, dp = old.grid.u_v, old.grid.dp_pa
        for s in (0.25, 0.5, 0.75):
            for t in (0.25, 0.5, 0.75):
                at = u[i] + s * (u[i + 1] - u[i]), dp[j] + t * (dp[j + 1] - dp[j])
                q = old.flow(*at)
                change += float(((new.flow(*at) - q) ** 2).sum())
                size += float((q**2).sum())
    return float(np.sqrt(change / size))


def _lowest(gram: FloatArray, before: Solution, after: Solution) -> float:
    """Smallest eigenvalue of the information on the compliances and all blocks once valid."""
    valid = {(b.edge, b.i, b.j) for b in before.blocks if b.status == VALID}
    known = np.ones(len(gram), bool)
    first = len(gram) - TERMS * len(after.blocks)
    for place, b in enumerate(after.blocks):
        known[first + TERMS * place :][:TERMS] = (b.edge, b.i, b.j) in valid
    own = gram[np.ix_(known, known)]
    scale = np.sqrt(np.diag(own))
    return float(np.linalg.eigvalsh(own / np.outer(scale, scale))[0])


@dataclass(frozen=True)
class Loss:
    """Samples of standstill after which a recursion fails; None where it has not.

    indefinite: its covariance has an eigenvalue <= 0 or is not finite; wrong: its map of the block
    is changed by as much as itself, relative L2.
    """

    indefinite: int | None
    wrong: int | None


def stand_rival(
    rival: type[Recursion], way: str, most: int, forget: float = 0.999, every: int = 100
) -> Loss:
    """The same record in a recursion of one block, up to `most` samples of standstill."""
    model, run = forgetful(COARSE, np.inf), motion()
    block = OneBlock(model, (-10.0, 10.0), (-0.3e6, 10e6))
    recursion = rival(*unknown(), forget)
    for row in block.rows(to_chunk(model, run.samples, 0)[-10_000:]):  # it has forgotten the rest
        recursion.take(row[:-1], row[-1])
    still = np.concatenate(list(standing(run, way, most * STEP_S)))
    start, loss = recursion.theta.copy(), Loss(None, None)
    for k, row in enumerate(block.rows(still)):
        recursion.take(row[:-1], row[-1])
        if k % every == 0:
            loss = _lost(loss, k, recursion, start)
        if None not in (loss.indefinite, loss.wrong):
            break
    return loss


def _lost(loss: Loss, k: int, recursion: Recursion, start: FloatArray) -> Loss:
    P, theta = recursion.covariance, recursion.theta
    definite = bool(np.isfinite(P).all()) and np.linalg.eigvalsh(0.5 * (P + P.T))[0] > 0
    s, t = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9))
    phi = np.stack([np.ones_like(s), s, t, s * s, t * t, s * t], axis=-1)
    change, size = phi @ (theta - start)[:-1], phi @ start[:-1]
    right = bool(np.linalg.norm(change) <= np.linalg.norm(size))
    return Loss(
        loss.indefinite if loss.indefinite is not None or definite else k,
        loss.wrong if loss.wrong is not None or right else k,
    )
