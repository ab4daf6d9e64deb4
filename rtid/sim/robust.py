"""An adaptive robust controller of the boom (Liu and Yao), adaptation off: the product's neighbour.

Each of four valves has a command of its own.  With z1 = x - x_d, v_r = v_d - k z1, z2 = v - v_r,
and all gains k:

    F   = m (dv_r/dt - k z2) + gravity(x) + friction          force that is wanted of the cylinder
    P_d = (F + A_B P_B) / A_A                                  by chamber A
    Q_A = A_A v + V_A / beta (dP_d/dt - k (P_A - P_d))         flow into A
    Q_B = - A_B v - V_B / beta k (P_B - P_off)                 keeps B at its low pressure

A positive flow is metered in from the supply, a negative one out to the tank (the working modes):
the command is w = Q^-1(|flow|, dp) of that valve's map.  The map is all that differs between runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from rtid.sim.equations import flows
from rtid.sim.loop import LOAD, P_SUPPLY, P_TANK, Machine, Spools, advance, new_spools, quantise
from rtid.sim.motion import DT_S
from rtid.sim.plant import AT, BT, EDGES, PA, PB, Constants, FloatArray, Plant, flow_gain
from rtid.sim.sensing import P_A, P_B, P_S, P_T, Sensors, U, V, X

GAIN_1PS = 16.0  # of the paper
OFF_SIDE_PA = 5e6  # takes A near the pressures that it has in the sweep
LEAST_FLOW_M3S = 5e-7  # less is not metered: both valves of the chamber stay shut
SUBSTEPS = 10
FOUR = EDGES[:4]
W_V, DP_PA = np.linspace(0.0, 9.0, 901), np.linspace(0.0, 10e6, 101)  # lattice of the maps

Flow = Callable[[str, FloatArray, FloatArray], FloatArray]


class Knowledge(NamedTuple):
    """What the controller knows: the machine's constants, and maps (4, w, dp) in m3/s."""

    c: Constants
    maps: FloatArray
    w_v: FloatArray
    dp_pa: FloatArray


@dataclass(frozen=True)
class Tracked:
    """One run: position error (n,) m, pressures of A and B (n, 2), commands (n, 4), energy in J."""

    error_m: FloatArray
    pressures_pa: FloatArray
    commands_v: FloatArray
    energy_j: float

    @property
    def rms_m(self) -> float:
        """Root mean square of the tracking error."""
        return float(np.sqrt(np.mean(self.error_m**2)))

    @property
    def largest_m(self) -> float:
        """Largest tracking error."""
        return float(np.abs(self.error_m).max())


def knowledge(plant: Plant, flow: Flow) -> Knowledge:
    """The machine as the controller sees it; flow(edge, w, dp): its map, made to rise with w."""
    w, dp = np.meshgrid(W_V, DP_PA, indexing="ij")
    maps = [np.maximum.accumulate(np.nan_to_num(flow(e, w, dp)), axis=0) for e in FOUR]
    return Knowledge(plant.constants, np.array(maps), W_V, DP_PA)


@njit(cache=True, error_model="numpy")
def opening(flow: FloatArray, w_v: FloatArray, dp_pa: FloatArray, q: float, dp: float) -> float:
    """The command of one map (w, dp), linear between its points, for a wanted flow q > 0."""
    at = min(max(dp, dp_pa[1]), dp_pa[-1]) / (dp_pa[1] - dp_pa[0])
    j = min(int(at), len(dp_pa) - 2)
    share = at - j
    low, high = 0, len(w_v) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if flow[middle, j] + share * (flow[middle, j + 1] - flow[middle, j]) < q:
            low = middle
        else:
            high = middle
    below = flow[low, j] + share * (flow[low, j + 1] - flow[low, j])
    above = flow[high, j] + share * (flow[high, j + 1] - flow[high, j])
    part = (q - below) / (above - below) if above > below else 1.0
    return w_v[low] + min(max(part, 0.0), 1.0) * (w_v[high] - w_v[low])


@njit(cache=True, error_model="numpy")
def wanted_flows(
    c: Constants, k: float, lead_s: float, seen: FloatArray, ref: FloatArray
) -> tuple[float, float]:
    """Q_A and Q_B for measured signals (7,) and the reference's x, v, a and jerk (4,).

    lead_s: the flows are those of so much later, as far as the reference tells them.
    """
    x, v, p_a, p_b = seen[X], seen[V], seen[P_A], seen[P_B]
    gravity = c.gravity_n + c.gravity_slope_npm * (x - 0.5 * c.stroke_m)
    side = math.tanh(ref[1] / c.coulomb_width_mps)
    friction = c.coulomb_n * side + c.viscous_nspm * v
    a = (p_a * c.area_a_m2 - p_b * c.area_b_m2 - gravity - friction) / c.mass_kg
    v_r, a_r = ref[1] - k * (x - ref[0]), ref[2] - k * (v - ref[1])
    force = c.mass_kg * (a_r - k * (v - v_r)) + gravity + friction
    j_r = ref[3] - k * (a - ref[2])
    rate = c.mass_kg * (j_r - k * (a - a_r)) + c.gravity_slope_npm * v + c.viscous_nspm * a
    rate += c.coulomb_n * (1.0 - side * side) / c.coulomb_width_mps * ref[2]
    off = -k * (p_b - OFF_SIDE_PA)
    p_d = (force + c.area_b_m2 * p_b) / c.area_a_m2
    p_rate = (rate + c.area_b_m2 * off) / c.area_a_m2
    volume_a = c.v0_a_m3 + c.area_a_m2 * x
    volume_b = c.v0_b_m3 + c.area_b_m2 * (c.stroke_m - x)
    soon = v + lead_s * ref[2]
    q_a = c.area_a_m2 * soon + volume_a / c.beta_pa * (p_rate - k * (p_a - p_d))
    return q_a, -c.area_b_m2 * soon + volume_b / c.beta_pa * off


@njit(cache=True, error_model="numpy")
def commands(known: Knowledge, seen: FloatArray, q_a: float, q_b: float, w: FloatArray) -> None:
    """Fill w (5,) in place: each chamber is fed by one valve or drained by the other."""
    w[:] = 0.0
    for q, inlet, outlet, p in ((q_a, PA, AT, seen[P_A]), (q_b, PB, BT, seen[P_B])):
        if abs(q) > LEAST_FLOW_M3S:
            edge, dp = (inlet, seen[P_S] - p) if q > 0 else (outlet, p - seen[P_T])
            w[edge] = opening(known.maps[edge], known.w_v, known.dp_pa, abs(q), dp)


@njit(cache=True, error_model="numpy")
def track(
    m: Machine,
    known: Knowledge,
    gain_1ps: float,
    ref: FloatArray,
    drive: FloatArray,
    noise: FloatArray,
    steps: FloatArray,
    y: FloatArray,
    record: FloatArray,
) -> float:
    """Run the loop; ref (n, 4), drive (n + 1, 8), noise (n, 7), y (4,) is changed in place.

    record (n, 7) is filled: error, P_A, P_B, four commands.  Returns the energy from the supply, J.
    """
    spools: Spools = new_spools(None, m.lag_s, 0.5 * DT_S / SUBSTEPS, 1)
    decay = math.exp(-0.5 * DT_S / SUBSTEPS / m.lag_s) if m.lag_s > 0.0 else 0.0
    gains, seen, q, energy_j = np.empty(5), np.empty(7), np.empty(5), 0.0
    for i in range(len(ref)):
        p_s, p_t = drive[i, P_SUPPLY], drive[i, P_TANK]
        seen[U], seen[P_S], seen[P_T] = 0.0, p_s, p_t
        seen[P_A], seen[P_B], seen[X], seen[V] = y[0], y[1], y[2], y[3]
        for column in range(7):
            seen[column] = quantise(seen[column] + noise[i, column], steps[column])
        q_a, q_b = wanted_flows(known.c, gain_1ps, m.lag_s + 0.5 * DT_S, seen, ref[i])
        commands(known, seen, q_a, q_b, spools.commands[1])
        record[i, 0], record[i, 1], record[i, 2] = y[2] - ref[i, 0], y[0], y[1]
        record[i, 3:] = spools.commands[1, :4]
        for edge in range(5):
            gains[edge] = flow_gain(m.valves[edge], spools.w[edge])
        flows(m.c, gains, y, p_s, p_t, q)
        energy_j += p_s * (q[PA] + q[PB]) * DT_S
        advance(m, None, gains, drive[i : i + 2], decay, 0.0, DT_S / SUBSTEPS, spools, y, SUBSTEPS)
    return energy_j


def run(plant: Plant, flow: Flow, reference: FloatArray, seed: int = 0) -> Tracked:
    """Follow a reference (n, 4) with a map; the same seed gives the same sensor noise."""
    n, sensors = len(reference), Sensors()
    noise = np.random.default_rng([seed, 11]).standard_normal((n, 7)) * sensors.noise()
    drive = np.zeros((n + 1, 8))
    drive[:, P_SUPPLY], drive[:, P_TANK], drive[:, LOAD] = plant.p_supply_pa, plant.p_tank_pa, 0.0
    x, c = float(reference[0, 0]), plant.constants
    p_a = (plant.gravity_n(x) + OFF_SIDE_PA * c.area_b_m2) / c.area_a_m2
    y, record = np.array([p_a, OFF_SIDE_PA, x, 0.0]), np.empty((n, 7))
    machine = Machine(
        c, plant.controller, plant.valve_table(), np.array(plant.directions, float), plant.lag_s
    )
    energy_j = track(
        machine,
        knowledge(plant, flow),
        GAIN_1PS,
        reference,
        drive,
        noise,
        sensors.resolution(),
        y,
        record,
    )
    return Tracked(record[:, 0], record[:, 1:3], record[:, 3:], float(energy_j))
