"""The closed loop as one kernel: sensors at 1 kHz, position controller, held command, RK4 between.

State y = (P_A, P_B, x, v).  Supply, tank and load force run linearly between samples; the lag of
the valves is exact for a held command: w(t_k + t) = u_k + (w(t_k) - u_k) exp(-t / tau).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rtid.sim.plant import (
    AB,
    AT,
    BT,
    PA,
    PB,
    Constants,
    Controller,
    FloatArray,
    flow_gain,
    metered_flow,
)

X_REF, V_REF, DITHER, P_SUPPLY, P_TANK, LOAD = range(6)  # columns of the drive


@njit(cache=True)
def quantise(value: float, step: float) -> float:
    """The nearest multiple of `step`; the value itself for step 0."""
    return value if step == 0.0 else step * math.floor(value / step + 0.5)


@njit(cache=True)
def command(k: Controller, drive: FloatArray, x_m: float) -> float:
    """The controller's signed command from one row of the drive and the measured position."""
    demand: float = drive[V_REF] + k.kp_1ps * (drive[X_REF] - x_m)
    compensation = k.deadband_v * math.tanh(demand / k.blend_mps)
    u: float = compensation + k.volts_per_mps * demand + drive[DITHER]
    return min(max(u, -k.limit_v), k.limit_v)


@njit(cache=True)
def flows(
    c: Constants, gains: FloatArray, y: FloatArray, p_s: float, p_t: float, q: FloatArray
) -> None:
    """Fill q (5,) in place with the flow of each edge."""
    q[PA] = metered_flow(gains[PA], p_s - y[0], c.dp_laminar_pa)
    q[AT] = metered_flow(gains[AT], y[0] - p_t, c.dp_laminar_pa)
    q[PB] = metered_flow(gains[PB], p_s - y[1], c.dp_laminar_pa)
    q[BT] = metered_flow(gains[BT], y[1] - p_t, c.dp_laminar_pa)
    q[AB] = metered_flow(gains[AB], y[0] - y[1], c.dp_laminar_pa)


@njit(cache=True)
def rates(c: Constants, q: FloatArray, y: FloatArray, load_n: float, dy: FloatArray) -> None:
    """Fill dy (4,) in place with the time derivative of the state for the flows q."""
    x, v = y[2], y[3]
    volume_a = c.v0_a_m3 + c.area_a_m2 * x
    volume_b = c.v0_b_m3 + c.area_b_m2 * (c.stroke_m - x)
    dy[0] = c.beta_pa * (q[PA] - q[AT] - q[AB] - c.area_a_m2 * v) / volume_a
    dy[1] = c.beta_pa * (q[PB] - q[BT] + q[AB] + c.area_b_m2 * v) / volume_b
    gravity = c.gravity_n + c.gravity_slope_npm * (x - 0.5 * c.stroke_m)
    friction = c.coulomb_n * math.tanh(v / c.coulomb_width_mps) + c.viscous_nspm * v
    force = y[0] * c.area_a_m2 - y[1] * c.area_b_m2 - gravity - load_n - friction
    dy[2] = v
    dy[3] = force / c.mass_kg


@njit(cache=True)
def runge_kutta(
    c: Constants,
    gains: FloatArray,
    inputs: FloatArray,
    h_s: float,
    y: FloatArray,
    slopes: FloatArray,
    trial: FloatArray,
    q: FloatArray,
) -> None:
    """One step of the classical fourth-order rule; y (4,) is changed in place.

    gains (3, 5) and inputs (3, 3) = (supply, tank, load) hold at the start, middle and end of the
    step; slopes (4, 4), trial (4,) and q (5,) are work space.
    """
    for stage in range(4):
        at = (stage + 1) // 2
        reach = h_s if stage == 3 else 0.5 * h_s
        for i in range(4):
            trial[i] = y[i] + reach * slopes[stage - 1, i] if stage > 0 else y[i]
        flows(c, gains[at], trial, inputs[at, 0], inputs[at, 1], q)
        rates(c, q, trial, inputs[at, 2], slopes[stage])
    for i in range(4):
        bend = slopes[1, i] + slopes[2, i]
        y[i] += h_s / 6.0 * (slopes[0, i] + 2.0 * bend + slopes[3, i])


@njit(cache=True)
def advance(
    c: Constants,
    valves: FloatArray,
    commands: FloatArray,
    drive: FloatArray,
    decay: float,
    h_s: float,
    substeps: int,
    w: FloatArray,
    y: FloatArray,
) -> None:
    """Integrate over one sample; w (5,) and y (4,) are changed in place.

    commands (5,) are held, drive (2, 6) are its rows at both ends, decay = exp(-h / (2 lag)).
    """
    gains, inputs = np.empty((3, 5)), np.empty((3, 3))
    slopes, trial, q = np.empty((4, 4)), np.empty(4), np.empty(5)
    for e in range(5):
        gains[2, e] = flow_gain(valves[e], w[e])
    for step in range(substeps):
        gains[0] = gains[2]
        for half in range(1, 3):
            for e in range(5):
                w[e] = commands[e] + (w[e] - commands[e]) * decay
                gains[half, e] = flow_gain(valves[e], w[e])
        for half in range(3):
            share = (step + 0.5 * half) / substeps
            for j in range(3):
                start = drive[0, P_SUPPLY + j]
                inputs[half, j] = start + share * (drive[1, P_SUPPLY + j] - start)
        runge_kutta(c, gains, inputs, h_s, y, slopes, trial, q)


@njit(cache=True)
def run_loop(
    c: Constants,
    k: Controller,
    valves: FloatArray,
    directions: FloatArray,
    lag_s: float,
    drive: FloatArray,
    x_noise_m: FloatArray,
    x_step_m: float,
    u_step_v: float,
    dt_s: float,
    substeps: int,
    y: FloatArray,
    signals: FloatArray,
    x_measured_m: FloatArray,
    opening_v: FloatArray,
    flow_m3s: FloatArray,
) -> None:
    """Simulate n samples from the state y (4,); drive (n + 1, 6), x_noise_m (n,).

    Filled in place: signals (n, 5) with the true u, P_A, P_B, x, v;
    x_measured_m (n,); opening_v (n, 5) and flow_m3s (n, 5) as they are at the sample, just after
    the command has changed.  y ends at the state after the last sample.
    """
    h_s = dt_s / substeps
    decay = math.exp(-0.5 * h_s / lag_s) if lag_s > 0.0 else 0.0
    w, commands, gains = np.zeros(5), np.empty(5), np.empty(5)
    for i in range(len(signals)):
        x_measured_m[i] = quantise(y[2] + x_noise_m[i], x_step_m)
        u = quantise(command(k, drive[i], x_measured_m[i]), u_step_v)
        for e in range(5):
            commands[e] = directions[e] * u
            if lag_s <= 0.0:
                w[e] = commands[e]
            gains[e] = flow_gain(valves[e], w[e])
        signals[i, 0] = u
        signals[i, 1:] = y
        opening_v[i] = w
        flows(c, gains, y, drive[i, P_SUPPLY], drive[i, P_TANK], flow_m3s[i])
        advance(c, valves, commands, drive[i : i + 2], decay, h_s, substeps, w, y)
