"""Simulated machines that follow a reference with a map: what is logged, and what they really do.

The controller is written here again, after docs/tools.md: the prediction's own is not asked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from firmware_bridge.lookup import Table
from firmware_bridge.samples import ROW
from rtid.apply.judge import KnownMap
from rtid.estimator.chunk import to_chunk
from rtid.estimator.published import publish
from rtid.estimator.record import fit_record
from rtid.maps.lookup import sample
from rtid.model import POSITION, Machine, Signal
from rtid.plain import FloatArray
from rtid.sim.closed_loop import LOAD, P_SUPPLY, P_TANK, advance, new_spools, quantise
from rtid.sim.declare import declared_model
from rtid.sim.demand import DT_S
from rtid.sim.random_plants import draw
from rtid.sim.run import at_rest, machine_of, simulate
from rtid.sim.sensing import NAMES, P_A, P_B, P_S, Sensors, U, X
from rtid.sim.simulated_plant import SimulatedPlant, flow_gain

SUBSTEPS = 10
KP_1PS = 8.0


@dataclass(frozen=True)
class Tried:
    """One machine: what it is, what was learned of it, and the tables that its controller holds."""

    plant: SimulatedPlant
    model: Machine
    learned: KnownMap
    beta_sd_pa: FloatArray
    new: dict[str, Table]
    held: dict[str, Table]


def machine(seed: int, seconds: float = 40.0, law: str = "orifice") -> Tried:
    """Machine `seed`, learned from a rich record; it holds maps that are off by up to 12 %."""
    plant = draw(seed, law=law)
    model = declared_model(plant, seed=seed)
    samples = simulate(plant, "rich", seed, seconds).samples
    fit = fit_record(model, to_chunk(model, samples, int(samples.t_us[0])))
    flow_map = publish(fit.solution)
    beta, sd = fit.solution.beta_pa, fit.solution.beta_sd_pa
    new = {e.name: sample(e, flow_map[e.name]).table for e in model.edges}
    off = np.random.default_rng([seed, 40]).uniform(0.88, 1.12, len(model.edges))
    held = {
        e.name: replace(new[e.name], scale=float(k * new[e.name].scale))
        for e, k in zip(model.edges, off, strict=True)
    }
    logged = replace(model, signals=(*model.signals, Signal("x_ref", POSITION, "m")))
    return Tried(plant, logged, KnownMap(flow_map, beta), sd, new, held)


def path(plant: SimulatedPlant, seconds: float, seed: int) -> FloatArray:
    """A reference x, v (n, 2): sines that nobody has learned from."""
    t = np.arange(round(seconds / DT_S)) * DT_S
    rng = np.random.default_rng([seed, 41])
    x, v = np.full_like(t, 0.5 * plant.constants.stroke_m), np.zeros_like(t)
    for hz, size in ((0.11, 0.04), (0.29, 0.015), (0.53, 0.006)):
        at = 2 * np.pi * (hz * t + rng.uniform())
        x += size * np.sin(at)
        v += size * 2 * np.pi * hz * np.cos(at)
    return np.stack([x, v], axis=1)


def needed_v(
    w_v: FloatArray, s: FloatArray, flow_m3s: FloatArray, q_m3s: float, dp_pa: float
) -> float:
    """The command for a wanted flow, by numpy's interpolation."""
    root = float(np.clip(np.sqrt(max(dp_pa, 0.0)), s[0], s[-1]))
    j = int(np.clip(np.searchsorted(s, root) - 1, 0, len(s) - 2))
    share = (root - s[j]) / (s[j + 1] - s[j])
    column = np.maximum.accumulate(flow_m3s[:, j] + share * (flow_m3s[:, j + 1] - flow_m3s[:, j]))
    first = int(np.searchsorted(column, 1e-12))  # the last command that passes nothing
    return float(np.interp(q_m3s, column[max(first - 1, 0) :], w_v[max(first - 1, 0) :]))


def follow(
    plant: SimulatedPlant, tables: dict[str, Table], ref: FloatArray, seed: int
) -> tuple[FloatArray, FloatArray]:
    """True position (n,), m, and what the sensors said (n, 7), columns as `sensing.NAMES`."""
    sensors = Sensors()
    n, steps = len(ref), sensors.resolution()
    noise = np.random.default_rng([seed, 42]).standard_normal((n, 7)) * sensors.noise()
    drive = np.zeros((2, 8))
    drive[:, P_SUPPLY], drive[:, P_TANK], drive[:, LOAD] = plant.p_supply_pa, plant.p_tank_pa, 0.0
    drive[:, LOAD + 1] = 1.0
    m, c = machine_of(plant), plant.constants
    y = at_rest(plant, drive[0], float(ref[0, 0]), 0.3 * plant.p_supply_pa)
    half_s = 0.5 * DT_S / SUBSTEPS
    spools, decay = new_spools(None, m.lag_s, half_s, 1), float(np.exp(-half_s / m.lag_s))
    x, seen = np.empty(n), np.empty((n, 7))
    arrays = {k: (t.w_v.astype(float), t.s.astype(float), t.flow_m3s) for k, t in tables.items()}
    for i in range(n):
        true = (0.0, y[0], y[1], plant.p_supply_pa, plant.p_tank_pa, y[2], y[3])  # as NAMES
        said = [quantise(a + b, c) for a, b, c in zip(true, noise[i], steps, strict=True)]
        speed = ref[i, 1] + KP_1PS * (ref[i, 0] - said[X])
        inlet, p, area = ("pa", P_A, c.area_a_m2) if speed > 0 else ("pb", P_B, c.area_b_m2)
        u = needed_v(*arrays[inlet], area * abs(speed), said[P_S] - said[p])
        said[U] = quantise(u if speed > 0 else -u, steps[U])
        x[i], seen[i] = y[2], said
        for edge in range(5):
            spools.commands[1, edge] = m.directions[edge] * said[U]
        gains = np.array([flow_gain(m.valves[k], spools.w[k]) for k in range(5)])
        advance(m, None, gains, drive, decay, 0.0, DT_S / SUBSTEPS, spools, y, SUBSTEPS)
    return x, seen


def logged(tried: Tried, seen: FloatArray, ref: FloatArray) -> FloatArray:
    """The record (n, 2 + signals) of a run, beside its reference."""
    n = len(seen)
    columns = [seen[:, NAMES.index(s.name)] for s in tried.model.signals[:-1]]
    return np.column_stack([np.arange(n) * DT_S, np.full(n, ROW), *columns, ref[:, 0]])


def rms_m(x: FloatArray, ref: FloatArray) -> float:
    """Tracking error behind the first half second."""
    return float(np.sqrt(np.mean((x - ref[:, 0])[500:] ** 2)))
