"""The closed loop as one kernel: sensors at 1 kHz, position controller, held command, RK4 between.

State y = (P_A, P_B, x, v), longer with extra physics (see `extra_flows`).  Supply, tank and load
force run linearly between samples; the lag of the valves is exact for a held command:
w(t_k + t) = u_k + (w(t_k) - u_k) exp(-t / tau).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rtid.plain import FloatArray
from rtid.sim.compiled import compiled
from rtid.sim.dynamics import flows, runge_kutta
from rtid.sim.extra_flows import PORT_A, PORT_B, SUPPLY, extra_flows, extra_valve_flows
from rtid.sim.simulated_plant import Constants, Controller, flow_gain
from rtid.sim.spool import PLAYS, acting, follow, play, spool_table, sticking_pilot, travel

# columns of the drive; the last two are of extra physics: factor of all gains, bursts
X_REF, V_REF, DITHER, P_SUPPLY, P_TANK, LOAD, FACTOR, BURST = range(8)


class PlainMachine(NamedTuple):
    """What the kernel knows of a plain plant: valves (5, columns), directions (5,)."""

    c: Constants
    k: Controller
    valves: FloatArray
    directions: FloatArray
    lag_s: float


class LoopRecord(NamedTuple):
    """What the kernel fills, at the samples, just after the command has changed.

    signals (n, 5): true u, P_A, P_B, x, v; x_measured_m (n,); opening_v (n, 5); flow_m3s (n, 5);
    nodes_pa (n, 3): supply and both chambers as the valves see them; extra_m3s (n, 2): flows into
    the chambers past the valves.
    """

    signals: FloatArray
    x_measured_m: FloatArray
    opening_v: FloatArray
    flow_m3s: FloatArray
    nodes_pa: FloatArray
    extra_m3s: FloatArray


class Spools(NamedTuple):
    """The valves: openings and rates (5,), commands (2, 5) before and after a change, propagators.

    table (5, 4) over half a substep; plays (PLAYS,); pilot (3,); pilot_v (n,): given so far.
    """

    w: FloatArray
    rate: FloatArray
    commands: FloatArray
    table: FloatArray
    plays: FloatArray
    pilot: FloatArray
    pilot_v: FloatArray


@compiled
def quantise(value: float, step: float) -> float:
    """The nearest multiple of `step`; the value itself for step 0."""
    return value if step == 0.0 else step * math.floor(value / step + 0.5)


@compiled
def command(k: Controller, drive: FloatArray, x_m: float) -> float:
    """The controller's signed command, V, from one row of the drive and the measured position.

    drive (8,), SI.  Without a reference (NaN) the controller is off and the valves are shut.
    """
    demand: float = drive[V_REF] + k.kp_1ps * (drive[X_REF] - x_m)
    if math.isnan(demand):
        return 0.0
    compensation = k.deadband_v * math.tanh(demand / k.blend_mps)
    u: float = compensation + k.volts_per_mps * demand + drive[DITHER]
    return min(max(u, -k.limit_v), k.limit_v)


@compiled
def advance(
    m: PlainMachine,
    e: Any,
    start_gains: FloatArray,
    drive: FloatArray,
    decay: float,
    change_s: float,
    h_s: float,
    spools: Spools,
    y: FloatArray,
    substeps: int,
) -> None:
    """Integrate over one sample; y and the spools are changed in place.

    start_gains (5,) hold at its start, drive (2, 8) are its rows at both ends, decay =
    exp(-h / (2 lag)); commands[0] act until change_s after the sample, then commands[1].
    """
    gains, inputs = np.empty((3, 5)), np.empty((3, 5))
    slopes, trial, q, net = np.empty((4, len(y))), np.empty(len(y)), np.empty(5), np.empty(2)
    valves, w, rate, table = m.valves, spools.w, spools.rate, spools.table
    before, after = spools.commands[0], spools.commands[1]
    for edge in range(5):
        gains[2, edge] = start_gains[edge]
    for step in range(substeps):
        for edge in range(5):
            gains[0, edge] = gains[2, edge]
        for half in range(3):
            share = (step + 0.5 * half) / substeps
            for j in range(inputs.shape[1]):
                start = drive[0, P_SUPPLY + j]
                inputs[half, j] = start + share * (drive[1, P_SUPPLY + j] - start)
        for half in range(1, 3):
            if e is None:
                for edge in range(5):
                    w[edge] = after[edge] + (w[edge] - after[edge]) * decay
            else:
                until_s = change_s - (step + 0.5 * (half - 1)) * h_s
                if until_s <= 0.0:
                    follow(e, m.lag_s, after, 0.5 * h_s, table, w, rate)
                else:
                    travel(e, m.lag_s, before, after, until_s, 0.5 * h_s, table, w, rate)
            for edge in range(5):
                gains[half, edge] = flow_gain(valves[edge], w[edge])
                if e is not None:
                    gains[half, edge] *= inputs[half, FACTOR - P_SUPPLY]
        runge_kutta(m.c, e, valves, gains, inputs, h_s, y, slopes, trial, q, net)


@compiled
def steer(m: PlainMachine, e: Any, i: int, dt_s: float, u_v: float, spools: Spools) -> float:
    """Set the commands of the five edges; returns until when the former ones act, s."""
    change_s = 0.0
    if e is None:
        for edge in range(5):
            spools.commands[1, edge] = m.directions[edge] * u_v
    else:
        if e.whole.play_v > 0.0:
            u_v = play(u_v, e.whole.play_v, spools.plays)
        if e.whole.stick_v > 0.0:
            u_v = sticking_pilot(u_v, e.whole.stick_v, spools.pilot)
        spools.pilot_v[i] = u_v
        late = math.floor(e.whole.delay_s / dt_s)
        change_s = e.whole.delay_s - late * dt_s
        for edge in range(5):
            spools.commands[0, edge] = m.directions[edge] * acting(spools.pilot_v, i, late + 1)
            spools.commands[1, edge] = m.directions[edge] * acting(spools.pilot_v, i, late)
    return change_s


@compiled
def seen_position(e: Any, x: FloatArray, i: int, dt_s: float) -> float:
    """Position that the sensor shows of x (n,) at sample i, before noise, m."""
    late = 0.0
    if e is not None:
        late = e.whole.position_delay_s / dt_s
    if late == 0.0 or late >= i:
        return x[i] if late == 0.0 else x[0]
    row = math.floor(i - late)
    return x[row] + (i - late - row) * (x[min(row + 1, i)] - x[row])


@compiled
def note_flows(
    c: Constants,
    e: Any,
    valves: FloatArray,
    gains: FloatArray,
    drive: FloatArray,
    y: FloatArray,
    i: int,
    record: LoopRecord,
) -> None:
    """Write flows, m3/s, and pressures at the valves, Pa, at sample i.

    valves (5, columns) have the gains (5,), m3/s/sqrt(Pa).
    """
    nodes = record.nodes_pa[i]
    if e is None:
        nodes[0], nodes[1], nodes[2] = drive[P_SUPPLY], y[0], y[1]
        flows(c, valves, gains, y, drive[P_SUPPLY], drive[P_TANK], record.flow_m3s[i])
    else:
        inputs = drive[P_SUPPLY:]
        extra_valve_flows(c, e, valves, gains, inputs, y, record.flow_m3s[i])
        extra_flows(c, e, inputs, y, record.extra_m3s[i])
        nodes[0], nodes[1], nodes[2] = y[SUPPLY], y[PORT_A], y[PORT_B]


@compiled
def new_spools(e: Any, lag_s: float, half_s: float, n: int) -> Spools:
    """Spools at rest in their middle."""
    table = np.zeros((5, 4))
    if e is not None:
        spool_table(e, lag_s, half_s, table)
    commands = np.zeros((2, 5))
    pilot = np.array([0.0, 0.0, 1.0])
    given = np.zeros(0 if e is None else n)
    return Spools(np.zeros(5), np.zeros(5), commands, table, np.zeros(PLAYS), pilot, given)


@compiled
def run_loop(
    m: PlainMachine,
    e: Any,
    drive: FloatArray,
    x_noise_m: FloatArray,
    x_step_m: float,
    u_step_v: float,
    dt_s: float,
    substeps: int,
    y: FloatArray,
    record: LoopRecord,
) -> None:
    """Simulate n samples from the state y; drive (n + 1, 8), x_noise_m (n,).

    e: `extra.Parts`, or None for the plain machine, which is compiled without it.

    The record is filled in place; y ends at the state after the last sample.
    """
    h_s, x = dt_s / substeps, record.signals[:, 3]
    decay = math.exp(-0.5 * h_s / m.lag_s) if m.lag_s > 0.0 else 0.0
    gains = np.empty(5)
    spools = new_spools(e, m.lag_s, 0.5 * h_s, len(x))
    at_once = m.lag_s <= 0.0
    if e is not None:
        moves = e.whole.spool_lag_s + e.whole.spool_radps + e.whole.spool_rate_vps
        at_once = m.lag_s + moves <= 0.0
    for i in range(len(x)):
        for j in range(4):
            record.signals[i, 1 + j] = y[j]
        x_measured_m = quantise(seen_position(e, x, i, dt_s) + x_noise_m[i], x_step_m)
        u = quantise(command(m.k, drive[i], x_measured_m), u_step_v)
        record.x_measured_m[i], record.signals[i, 0] = x_measured_m, u
        change_s = steer(m, e, i, dt_s, u, spools)
        now = spools.commands[0 if change_s > 0.0 else 1]
        for edge in range(5):
            if at_once:
                spools.w[edge] = now[edge]
            record.opening_v[i, edge] = spools.w[edge]
            gains[edge] = flow_gain(m.valves[edge], spools.w[edge])
        if e is not None:
            gains *= drive[i, FACTOR]
        note_flows(m.c, e, m.valves, gains, drive[i], y, i, record)
        advance(m, e, gains, drive[i : i + 2], decay, change_s, h_s, spools, y, substeps)
