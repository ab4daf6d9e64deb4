"""Run the simulated machine: what its sensors say (samples) beside what is true.

u at sample k acts until sample k + 1; sensors are read at sample k, before the command changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_bridge.samples import GAP, ROW, Samples
from rtid.errors import RtidError
from rtid.sim.loop import P_SUPPLY, P_TANK, X_REF, run_loop
from rtid.sim.motion import DT_S, MOTIONS, Motion
from rtid.sim.plant import EDGES, FloatArray, Plant

NAMES = ("u", "p_a", "p_b", "p_supply", "p_tank", "x", "v")
U, P_A, P_B, P_S, P_T, X, V = range(7)  # columns of NAMES
COUNTS = 65535  # 16 bit


class SimulationError(RtidError):
    """The machine left its stroke, cavitated or exceeded a sensor's range."""


@dataclass(frozen=True)
class Sensors:
    """White noise (1 sigma) and range of each sensor, SI; 16 bit over the range."""

    p_noise_pa: float = 5e3
    p_tank_noise_pa: float = 1e3
    x_noise_m: float = 1e-5
    v_noise_mps: float = 1e-3
    p_range_pa: float = 10e6
    x_range_m: float = 0.5
    v_range_mps: float = 1.0  # -0.5..0.5
    u_range_v: float = 20.0  # -10..10
    quantised: bool = True

    def noise(self) -> FloatArray:
        """1 sigma per column of NAMES, float64 (7,)."""
        p = self.p_noise_pa
        return np.array([0, p, p, p, self.p_tank_noise_pa, self.x_noise_m, self.v_noise_mps])

    def resolution(self) -> FloatArray:
        """Quantisation step per column of NAMES, float64 (7,); 0: not quantised."""
        p = self.p_range_pa
        ranges = np.array([self.u_range_v, p, p, p, p, self.x_range_m, self.v_range_mps])
        return ranges / COUNTS if self.quantised else np.zeros(7)


EXACT = Sensors(p_noise_pa=0, p_tank_noise_pa=0, x_noise_m=0, v_noise_mps=0, quantised=False)


@dataclass(frozen=True)
class Truth:
    """What no sensor sees, at the sample instants.

    signals (n, 7): noise-free, columns as NAMES; opening_v (n, 5): w behind the lag, flow_m3s
    (n, 5): both per edge of `plant.EDGES`, just after the command has changed.
    """

    signals: FloatArray
    opening_v: FloatArray
    flow_m3s: FloatArray
    x_ref_m: FloatArray

    def flow(self, edge: str) -> FloatArray:
        """True flow through an edge, m3/s, float64 (n,)."""
        return self.flow_m3s[:, EDGES.index(edge)]


@dataclass(frozen=True)
class Run:
    """One simulated record."""

    plant: Plant
    sensors: Sensors
    samples: Samples
    truth: Truth


def simulate(
    plant: Plant,
    motion: str | Motion = "sweep",
    seed: int = 0,
    duration_s: float = 80.0,
    sensors: Sensors | None = None,
    substeps: int = 10,
) -> Run:
    """Run the closed loop for duration_s at 1 kHz; the same arguments give identical samples.

    motion: a name in `motion.MOTIONS` or a function of that kind.  Raises SimulationError if the
    machine leaves its stroke, cavitates, or a pressure exceeds its sensor's range.
    """
    sensors = sensors or Sensors()
    motion_rng, noise_rng = (np.random.default_rng([seed, stream]) for stream in (2, 3))
    build = MOTIONS[motion] if isinstance(motion, str) else motion
    drive = build(plant, motion_rng, duration_s)
    noise = noise_rng.standard_normal((len(drive) - 1, 7)) * sensors.noise()
    truth, x_measured_m = _integrate(plant, drive, noise[:, X].copy(), sensors, substeps)
    _check_sane(plant, truth, sensors)
    return Run(plant, sensors, _measure(truth, noise, x_measured_m, sensors), truth)


def _integrate(
    plant: Plant, drive: FloatArray, x_noise_m: FloatArray, sensors: Sensors, substeps: int
) -> tuple[Truth, FloatArray]:
    n = len(x_noise_m)
    loop, x_measured_m = np.empty((n, 5)), np.empty(n)
    opening_v, flow_m3s = np.empty((n, 5)), np.empty((n, 5))
    steps = sensors.resolution()
    run_loop(
        plant.constants,
        plant.controller,
        plant.valve_table(),
        np.array(plant.directions, dtype=float),
        plant.lag_s,
        drive,
        x_noise_m,
        steps[X],
        steps[U],
        DT_S,
        substeps,
        _resting_state(plant, float(drive[0, X_REF])),
        loop,
        x_measured_m,
        opening_v,
        flow_m3s,
    )
    signals = np.empty((n, 7))
    signals[:, [U, P_A, P_B, X, V]] = loop
    signals[:, [P_S, P_T]] = drive[:-1, [P_SUPPLY, P_TANK]]
    return Truth(signals, opening_v, flow_m3s, drive[:-1, X_REF]), x_measured_m


def _resting_state(plant: Plant, x_m: float) -> FloatArray:
    """(P_A, P_B, x, v) at rest with the load held and chamber B at 30 % of the supply."""
    c = plant.constants
    p_b = 0.3 * plant.p_supply_pa
    return np.array([(plant.gravity_n(x_m) + p_b * c.area_b_m2) / c.area_a_m2, p_b, x_m, 0.0])


def _check_sane(plant: Plant, truth: Truth, sensors: Sensors) -> None:
    x, p = truth.signals[:, X], truth.signals[:, [P_A, P_B, P_S]]
    faults = {
        "leaves its stroke": ~((x > 0) & (x < plant.constants.stroke_m)),
        "cavitates": (p[:, :2] < 1e4).any(axis=1),
        "exceeds Sensors.p_range_pa; give a larger range": (p > sensors.p_range_pa).any(axis=1),
    }
    for what, where in faults.items():
        if where.any():
            raise SimulationError(f"the simulated machine {what}, at {where.argmax() * DT_S:g} s")


def _measure(
    truth: Truth, noise: FloatArray, x_measured_m: FloatArray, sensors: Sensors
) -> Samples:
    """What the sensors say; u and x were already read inside the loop."""
    values = truth.signals + noise
    if sensors.quantised:
        steps = sensors.resolution()
        values = np.floor(values / steps + 0.5) * steps
    values[:, U], values[:, X] = truth.signals[:, U], x_measured_m
    flags = np.full(len(values), ROW, dtype=np.uint8)
    flags[0] |= GAP
    return Samples(NAMES, 1000 * np.arange(len(values), dtype=np.int64), values, flags)
