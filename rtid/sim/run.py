"""Run the simulated machine: what its sensors say (samples) beside what is true.

u at sample k acts until sample k + 1; sensors are read at sample k, before the command changes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from firmware_bridge.samples import GAP, ROW, Samples
from rtid.errors import RtidError, door
from rtid.plain import FloatArray
from rtid.sim import extra_flows as state
from rtid.sim.closed_loop import P_SUPPLY, P_TANK, X_REF, LoopRecord, PlainMachine, run_loop
from rtid.sim.demand import DT_S, MOTIONS, Motion, usual_duration_s
from rtid.sim.extra_physics import NONE, parts_of
from rtid.sim.schedule import schedule
from rtid.sim.sensing import EXACT, NAMES, P_A, P_B, P_S, P_T, Sensors, U, V, X, see
from rtid.sim.simulated_plant import EDGES, SimulatedPlant

__all__ = [
    "EXACT", "NAMES", "P_A", "P_B", "P_S", "P_T", "PlantChange", "Run", "Sensors",
    "SimulationError", "Truth", "U", "V", "X", "simulate",
]  # fmt: skip


START_SHARE = 0.3  # of the supply pressure in chamber B


class SimulationError(RtidError):
    """The machine left its stroke, cavitated or exceeded a sensor's range."""


@dataclass(frozen=True)
class Truth:
    """What no sensor sees, at the sample instants.

    signals (n, 7): noise-free, columns as NAMES; opening_v (n, 5): w behind the lag, flow_m3s
    (n, 5): both per edge of `plant.EDGES`, just after the command has changed; ports_pa (n, 2): the
    pressures of A and B at the valves; extra_m3s (n, 2): what hidden physics lets into each chamber
    past the valves.
    """

    signals: FloatArray
    opening_v: FloatArray
    flow_m3s: FloatArray
    x_ref_m: FloatArray
    ports_pa: FloatArray
    extra_m3s: FloatArray

    def flow(self, edge: str) -> FloatArray:
        """True flow through an edge, m3/s, float64 (n,)."""
        return self.flow_m3s[:, EDGES.index(edge)]


@dataclass(frozen=True)
class PlantChange:
    """What a plant becomes at a time; the valves' spools start again from their middle."""

    at_s: float
    plant: SimulatedPlant


@dataclass(frozen=True)
class Run:
    """One simulated record; `plant` is that of its end."""

    plant: SimulatedPlant
    sensors: Sensors
    samples: Samples
    truth: Truth


@door
def simulate(
    plant: SimulatedPlant,
    motion: str | Motion = "sweep",
    seed: int = 0,
    duration_s: float | None = None,
    sensors: Sensors | None = None,
    substeps: int = 10,
    change: PlantChange | None = None,
) -> Run:
    """Run the closed loop for duration_s at 1 kHz; the same arguments give identical samples.

    motion: a name in `motion.MOTIONS` or a function of that kind; duration_s: 80 s, and 110 s for
    a record with its validation part, unless told; change: what the plant becomes while it runs.
    Raises SimulationError if the machine leaves its stroke, cavitates, or a pressure exceeds its
    sensor's range.
    """
    sensors = sensors or Sensors()
    motion_rng, noise_rng, burst_rng = (np.random.default_rng([seed, i]) for i in (2, 3, 6))
    build = MOTIONS[motion] if isinstance(motion, str) else motion
    if duration_s is None:
        duration_s = usual_duration_s(motion if isinstance(motion, str) else "")
    drive = build(plant, motion_rng, duration_s)
    noise = noise_rng.standard_normal((len(drive) - 1, 7)) * sensors.noise()
    plants, ends = [plant], [0, len(noise)]
    if change is not None and 0 < round(change.at_s / DT_S) < len(noise):
        plants, ends = [plant, change.plant], [0, round(change.at_s / DT_S), len(noise)]
    truths: list[Truth] = []
    values: list[FloatArray] = []
    y = np.zeros(0)
    for present, first, end in zip(plants, ends, ends[1:], strict=False):
        clocked = schedule(present.extra, len(drive), DT_S, burst_rng)
        rows = np.column_stack([drive, clocked])[first : end + 1]
        y = _taken_over(present, y, rows[0]) if len(y) else _started(present, rows[0])
        truth, seen = _part(present, rows, noise[first:end], sensors, substeps, y)
        truths.append(truth)
        values.append(seen)
    return Run(plants[-1], sensors, _samples(np.concatenate(values)), _joined(truths))


def _part(
    plant: SimulatedPlant,
    drive: FloatArray,
    noise: FloatArray,
    sensors: Sensors,
    substeps: int,
    start: FloatArray,
) -> tuple[Truth, FloatArray]:
    """Truth and sensors' values (n, 7) of n samples of one plant from a state, changed in place."""
    truth, x_measured_m = _integrate(plant, drive, noise[:, X].copy(), sensors, substeps, start)
    _check_sane(plant, truth, sensors)
    seen = see(plant.extra, truth.signals, truth.ports_pa, drive[:-1, P_SUPPLY], noise, DT_S)
    values = sensors.quantise(seen)
    values[:, U], values[:, X] = truth.signals[:, U], x_measured_m
    return truth, values


def _joined(parts: list[Truth]) -> Truth:
    columns = (np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Truth))
    return Truth(*columns)


def _integrate(
    plant: SimulatedPlant,
    drive: FloatArray,
    x_noise_m: FloatArray,
    sensors: Sensors,
    substeps: int,
    start: FloatArray,
) -> tuple[Truth, FloatArray]:
    n, steps = len(x_noise_m), sensors.resolution()
    five = np.empty((3, n, 5))
    record = LoopRecord(
        five[0],
        np.empty(n),
        five[1],
        five[2],
        nodes_pa=np.empty((n, 3)),
        extra_m3s=np.zeros((n, 2)),
    )
    machine, e = machine_of(plant), parts_of(plant.extra)
    run_loop(machine, e, drive, x_noise_m, steps[X], steps[U], DT_S, substeps, start, record)
    signals = np.empty((n, 7))
    signals[:, [U, P_A, P_B, X, V]] = record.signals
    signals[:, P_S], signals[:, P_T] = record.nodes_pa[:, 0], drive[:-1, P_TANK]
    x_ref_m = drive[:-1, X_REF]
    truth = Truth(
        signals, record.opening_v, record.flow_m3s, x_ref_m, record.nodes_pa[:, 1:],
        record.extra_m3s,
    )  # fmt: skip
    return truth, record.x_measured_m


def machine_of(plant: SimulatedPlant) -> PlainMachine:
    """What the kernel needs of the plant."""
    directions = np.array(plant.directions, dtype=float)
    return PlainMachine(
        plant.constants, plant.controller, plant.valve_table(), directions, plant.lag_s
    )


def _started(plant: SimulatedPlant, drive: FloatArray) -> FloatArray:
    return at_rest(plant, drive, float(drive[X_REF]), START_SHARE * plant.p_supply_pa)


def at_rest(plant: SimulatedPlant, drive: FloatArray, x_m: float, p_b_pa: float) -> FloatArray:
    """The state (STATES,) of a machine that holds its load, chamber B at this pressure, at rest."""
    c = plant.constants
    p_a_pa = (plant.gravity_n(x_m) + p_b_pa * c.area_b_m2) / c.area_a_m2
    return _spread(plant, np.array([p_a_pa, p_b_pa, x_m, 0.0]), drive)


def _taken_over(plant: SimulatedPlant, before: FloatArray, drive: FloatArray) -> FloatArray:
    """The state of a machine that goes on as this plant: the piston and its chambers stay."""
    return _spread(plant, before[:4].copy(), drive)


def _spread(plant: SimulatedPlant, piston: FloatArray, drive: FloatArray) -> FloatArray:
    """A whole state from P_A, P_B, x, v (4,): all nodes at the pressures of their chambers."""
    if plant.extra == NONE:
        return piston
    y = np.zeros(state.STATES)
    p_a, p_b = piston[:2]
    y[[state.P_A, state.PORT_A, state.DEAD_A, state.HOSE_A]] = p_a
    y[[state.P_B, state.PORT_B, state.DEAD_B, state.HOSE_B]] = p_b
    y[[state.SUPPLY, state.BRANCH]] = drive[P_SUPPLY]
    y[[state.X, state.V]] = piston[2:]
    return y


def _check_sane(plant: SimulatedPlant, truth: Truth, sensors: Sensors) -> None:
    x, p = truth.signals[:, X], truth.signals[:, [P_A, P_B, P_S]]
    faults = {
        "leaves its stroke": ~((x > 0) & (x < plant.constants.stroke_m)),
        "cavitates": (p[:, :2] < 1e4).any(axis=1),
        "exceeds Sensors.p_range_pa; give a larger range": (p > sensors.p_range_pa).any(axis=1),
    }
    for what, where in faults.items():
        if where.any():
            raise SimulationError(f"the simulated machine {what}, at {where.argmax() * DT_S:g} s")


def _samples(values: FloatArray) -> Samples:
    """Complete rows at 1 kHz; the first one begins a record."""
    flags = np.full(len(values), ROW, dtype=np.uint8)
    flags[0] |= GAP
    return Samples(NAMES, 1000 * np.arange(len(values), dtype=np.int64), values, flags)
