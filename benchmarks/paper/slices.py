"""One-dimensional maps Q_i(dp), eq. (15), each at a command that is held.

The command is +u_i or -u_i all the time, the boom moves to and fro, and the supply swings slowly,
so that dp covers a wide range; each map is an interval of 0.04 V around u_i.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.paper.alone import alone
from benchmarks.paper.learning import Learned, learn
from rtid.estimator.flowmap import VALID
from rtid.model import Grid
from rtid.plain import FloatArray
from rtid.sim.boom import boom
from rtid.sim.closed_loop import P_SUPPLY, X_REF
from rtid.sim.demand import DT_S, standstill
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.tell.charts.points import working_points

COMMANDS_V = (3.0, 4.0, 5.0, 6.0)
HALF_WIDTH_V = 0.02
BESIDE_V = 0.3  # a block below, narrow: by the hysteresis a wide one would keep the working point
DURATION_S = 60.0
SUPPLY_PA, SWING, SWING_S = 6.4e6, 0.35, 20.0  # mean, share of it, period
EASE_MPS, REST_S = 0.03, 0.4  # of the controller; at each side
AHEAD = 2.5  # times the boom's speed
REACH = 0.2  # share of the stroke to either side
DP_STEP_PA, DP_MAX_PA = 1e6, 9e6
EDGE = "pa"
POINTS, TAIL = 200, 0.01  # of a map; share of the data beyond either end of it
Z95 = 1.96
DROP_ONLY = '\n[edge_defaults]\nterms = "drop"\n'


@dataclass(frozen=True)
class Slice:
    """Q_i(dp) at points dp_pa (n,): learned and true flow, stated sd, m3/s; valid points only."""

    w_v: float
    dp_pa: FloatArray
    flow: FloatArray
    sd: FloatArray
    true: FloatArray

    @property
    def error(self) -> FloatArray:
        """|learned - true| as shares of the largest flow (n,)."""
        return np.asarray(np.abs(self.flow - self.true) / self.true.max())

    @property
    def covered(self) -> FloatArray:
        """1 where the 95 % interval holds the truth (n,)."""
        return np.asarray(np.abs(self.flow - self.true) <= Z95 * self.sd, float)


def held(plant: SimulatedPlant, w_v: float) -> SimulatedPlant:
    """The machine with a controller that knows +w and -w alone, and eases off before it arrives."""
    k = plant.controller._replace(volts_per_mps=0.0, deadband_v=w_v, blend_mps=EASE_MPS)
    return replace(plant, controller=k)


def to_and_fro(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """The reference runs ahead of the boom from side to side; the supply swings."""
    drive = standstill(plant, rng, duration_s)
    t, k = DT_S * np.arange(len(drive)), boom().controller
    reach_m = REACH * plant.constants.stroke_m
    speed_mps = (plant.controller.deadband_v - k.deadband_v) / k.volts_per_mps
    half_s = 2 * reach_m / speed_mps + REST_S
    triangle = 4 * np.abs((t / (2 * half_s) + 0.25) % 1 - 0.5) - 1
    drive[:, X_REF] -= reach_m * np.clip(AHEAD * triangle, -1, 1)
    drive[:, P_SUPPLY] = SUPPLY_PA * (1 + SWING * np.sin(2 * np.pi * t / SWING_S))
    return drive


def one_dimensional(w_v: float, seed: int = 0, duration_s: float = DURATION_S) -> Slice:
    """Learn Q_i(dp) at one command from the frames of its own record."""
    near = [w_v - BESIDE_V, w_v - HALF_WIDTH_V, w_v + HALF_WIDTH_V]
    dp = np.arange(0.0, DP_MAX_PA + DP_STEP_PA / 2, DP_STEP_PA)
    blocks = Grid(np.array([1.0, *near]), dp)
    learned = learn(held(boom(), w_v), seed, to_and_fro, duration_s, blocks, DROP_ONLY)
    return _slice(learned, w_v)


def _slice(learned_map: Learned, w_v: float) -> Slice:
    """The map where its data lie."""
    learned, edge = alone(learned_map.replay.fit.solution)[EDGE], learned_map.model.edges[0]
    w, seen = working_points(learned_map.model, edge, learned_map.replay.chunk)
    low, high = np.quantile(seen[np.abs(w - w_v) < HALF_WIDTH_V], (TAIL, 1 - TAIL))
    dp = np.linspace(low, high, POINTS)
    dp = dp[learned.status_at(w_v, dp) == VALID]
    true = learned_map.plant.flow(EDGE, w_v, dp)
    return Slice(w_v, dp, learned.flow(w_v, dp), learned.sd(w_v, dp), true)
