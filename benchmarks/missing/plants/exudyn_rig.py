"""A cylinder of another library: Exudyn's hydraulic actuator, with pilots and wear of our own.

Exudyn integrates the mass and both chambers (Runge-Kutta 4, 0.25 ms); before each step it is told
how far its valves are open.  Its valve is an orifice, Q = opening K sqrt(dp); the openings are
those of random valves behind their lag, so that commands may come late, stick, drift or sag.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from benchmarks.missing.plants.own_simulator import POOR, RICH
from benchmarks.missing.plants.valve_records import RECORD_S, Simulated, case_of, noisy
from benchmarks.missing.record import SMALL, Case, Wish
from rtid.plain import FloatArray
from rtid.sim.closed_loop import LOAD, P_SUPPLY, P_TANK, X_REF, command
from rtid.sim.demand import DT_S, MOTIONS
from rtid.sim.random_plants import draw
from rtid.sim.sensing import Sensors
from rtid.sim.simulated_plant import SimulatedPlant, flow_gain

STEPS = 4  # of a sample
OFFSET_M = 0.7
NOMINAL = 1e-8  # m3/s/sqrt(Pa) of an opening of 1: only scales
RIGID_PA = 1e20
# delay in s, share of gains lost at the end, sag of the supply in Pa s/m3
HIDDEN = {"input_delay": 5e-3, "valve_gain_drift": 0.06, "supply_sag": 1.1e9}
TRIES = 20


def wishes(size: str) -> Iterator[Wish]:
    """Clean, rich and poor; then what can be done to a valve from outside."""
    if size == SMALL:
        return
    for motion in (RICH, POOR):
        yield _wish(motion, "", True)
    for effect in HIDDEN:
        yield _wish(RICH, effect, False)


def _wish(motion: str, effect: str, for_all: bool) -> Wish:
    name = " ".join(w for w in ("exudyn", "orifice", motion.partition("_")[0], effect) if w)
    return Wish(name, partial(_draw, name, motion, effect, for_all))


def _draw(name: str, motion: str, effect: str, for_all: bool, seed: int) -> Case | None:
    for number in range(seed, seed + TRIES):
        plant = draw(number)
        constants = plant.constants._replace(dp_laminar_pa=1.0)
        simulated = run(replace(plant, constants=constants), motion, number, effect)
        if simulated is not None:
            return case_of(
                simulated, number, effect, name=name, simulator="Exudyn", law="orifice",
                motion=motion.partition("_")[0], hidden=effect, level="middle" if effect else "",
                for_all=for_all,
            )  # fmt: skip
    return None


class _Rig:
    """The model in Exudyn, and what its pilots know."""

    def __init__(self, plant: SimulatedPlant, drive: FloatArray, seed: int, effect: str) -> None:
        exudyn, items = import_module("exudyn"), import_module("exudyn.itemInterface")
        self.exudyn, c = exudyn, plant.constants
        self.plant, self.drive, self.effect = plant, drive, effect
        self.valves, self.size = plant.valve_table(), HIDDEN.get(effect, 0.0)
        self.noise = np.random.default_rng([seed, 2]).standard_normal(len(drive)) * 1e-5
        self.keep = float(np.exp(-DT_S / STEPS / plant.lag_s))
        self.w, self.u = np.zeros(5), np.zeros(len(drive))
        n = len(drive) - 1
        self.true, self.openings = np.empty((n, 7)), np.empty((n, 5))
        self.system = exudyn.SystemContainer()
        mbs = self.mbs = self.system.AddSystem()
        x0, p_b = float(drive[0, X_REF]), 0.3 * plant.p_supply_pa
        p_a = (plant.gravity_n(x0) + p_b * c.area_b_m2) / c.area_a_m2
        ground = mbs.AddMarker(
            items.MarkerBodyPosition(bodyNumber=mbs.AddObject(items.ObjectGround()))
        )
        self.node = mbs.AddNode(
            items.NodePoint(referenceCoordinates=[OFFSET_M, 0, 0], initialCoordinates=[x0, 0, 0])
        )
        mass = mbs.AddObject(items.MassPoint(physicsMass=c.mass_kg, nodeNumber=self.node))
        piston = mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=mass))
        self.oil = mbs.AddNode(
            items.NodeGenericODE1(
                referenceCoordinates=[0, 0], initialCoordinates=[p_a, p_b],
                numberOfODE1Coordinates=2,
            )
        )  # fmt: skip
        self.actuator = mbs.AddObject(
            items.HydraulicActuatorSimple(
                markerNumbers=[ground, piston], nodeNumbers=[self.oil], offsetLength=OFFSET_M,
                strokeLength=c.stroke_m, chamberCrossSection0=c.area_a_m2,
                chamberCrossSection1=c.area_b_m2, hoseVolume0=c.v0_a_m3, hoseVolume1=c.v0_b_m3,
                oilBulkModulus=c.beta_pa, cylinderBulkModulus=RIGID_PA, hoseBulkModulus=RIGID_PA,
                nominalFlow=NOMINAL, systemPressure=plant.p_supply_pa,
                tankPressure=plant.p_tank_pa, useChamberVolumeChange=True,
            )
        )  # fmt: skip
        marker = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=self.node, coordinate=0))
        self.load = mbs.AddLoad(items.LoadCoordinate(markerNumber=marker, load=0.0))
        mbs.Assemble()
        mbs.SetPreStepUserFunction(self.before_step)

    def solve(self) -> None:
        """Run to the end of the drive."""
        settings, n = self.exudyn.SimulationSettings(), len(self.true)
        settings.timeIntegration.endTime = n * DT_S
        settings.timeIntegration.numberOfSteps = n * STEPS
        settings.timeIntegration.verboseMode = 0
        settings.solutionSettings.writeSolutionToFile = False
        self.mbs.SolveDynamic(settings, solverType=self.exudyn.DynamicSolverType.RK44)

    def before_step(self, mbs: Any, t: float) -> bool:
        """Sample, command, move the spools and set the openings; False ends the run."""
        kind, k = self.exudyn.OutputVariableType, round(t / DT_S * STEPS) - 1
        sample, first = divmod(max(k, 0), STEPS)
        if sample >= len(self.true):
            return True
        p_a, p_b = mbs.GetNodeOutput(self.oil, kind.Coordinates)
        x = float(mbs.GetNodeOutput(self.node, kind.Coordinates)[0])
        v = float(mbs.GetNodeOutput(self.node, kind.Coordinates_t)[0])
        if not (0.01 < x < self.plant.constants.stroke_m and p_a > 2e4 and p_b > 2e4):
            return False
        if first == 0:
            u = command(self.plant.controller, self.drive[sample], x + self.noise[sample])
            self.u[sample] = u
        late = round(self.size / DT_S) if self.effect == "input_delay" else 0
        u = self.u[max(sample - late, 0)] if sample >= late else 0.0
        target = np.array(self.plant.directions) * u
        gains = np.array([flow_gain(self.valves[e], self.w[e]) for e in range(4)]) / NOMINAL
        if self.effect == "valve_gain_drift":
            gains *= 1.0 + self.size * sample / len(self.true)
        p_supply = float(self.drive[sample, P_SUPPLY])
        if first == 0:
            sent, p_tank = self.u[sample], self.drive[sample, P_TANK]
            self.true[sample] = sent, p_a, p_b, p_supply, p_tank, x, v
            self.openings[sample] = self.w
        if self.effect == "supply_sag":
            drawn = NOMINAL * (
                gains[0] * np.sqrt(max(p_supply - p_a, 0.0))
                + gains[2] * np.sqrt(max(p_supply - p_b, 0.0))
            )
            p_supply -= self.size * drawn
        mbs.SetObjectParameter(self.actuator, "valveOpening0", float(gains[0] - gains[1]))
        mbs.SetObjectParameter(self.actuator, "valveOpening1", float(gains[2] - gains[3]))
        mbs.SetObjectParameter(self.actuator, "systemPressure", p_supply)
        c = self.plant.constants
        friction = c.coulomb_n * np.tanh(v / c.coulomb_width_mps) + c.viscous_nspm * v
        force = -self.plant.gravity_n(x) - self.drive[sample, LOAD] - friction
        mbs.SetLoadParameter(self.load, "load", float(force))
        self.w = target + (self.w - target) * self.keep
        return True


def run(plant: SimulatedPlant, motion: str, seed: int, effect: str) -> Simulated | None:
    """One record; None where the machine leaves its stroke or cavitates."""
    drive = MOTIONS[motion](plant, np.random.default_rng([seed, 2]), RECORD_S)
    wide = np.zeros((len(drive), 8))
    wide[:, : drive.shape[1]] = drive
    rig = _Rig(plant, wide, seed, effect)
    try:
        rig.solve()
    except ValueError:
        return None
    if not np.isfinite(rig.true).all() or (rig.true[-1, 5] == 0.0):
        return None

    seen = noisy(rig.true, seed, Sensors())
    return Simulated(plant, seen, rig.true, rig.openings, plant.flow)
