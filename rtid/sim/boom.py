"""The boom of the paper on the simulated rig, and its sweep.

The paper names neither pressures nor amplitude.  Here they are chosen so that the data lie where
its Fig. 4 and Table 1 have them: a supply of 8.5 MPa, a load that falls as the boom rises, and a
sweep that takes the command to 8.5 V.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from firmware_bridge.frames import Frames
from rtid.model import Grid, Machine
from rtid.plain import FloatArray
from rtid.sim.demand import swept_sine
from rtid.sim.project_file import project_text
from rtid.sim.random_plants import draw
from rtid.sim.run_files import write_log
from rtid.sim.simulated_plant import SimulatedPlant

SUPPLY_PA = 8.5e6
LOAD_SLOPE_1PM = -12e3 / 4500.0  # of the load in mid-stroke, per metre of stroke
TOP_V = 8.5  # command at the sweep's highest speed
TOP_HZ = 0.5
MOST_OF_STROKE = 0.35
SWEEP_S = 80.0


def boom(number: int | None = None) -> SimulatedPlant:
    """The default machine as the paper's boom, or the random machine with this number."""
    plant = SimulatedPlant() if number is None else draw(number)
    slope = LOAD_SLOPE_1PM * plant.constants.gravity_n
    constants = plant.constants._replace(gravity_slope_npm=slope)
    return replace(plant, p_supply_pa=SUPPLY_PA, constants=constants)


def sweep(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """The paper's swept sine (n + 1, 6), 0.1 to 0.5 Hz, as far as command and stroke allow."""
    k = plant.controller
    speed_mps = (TOP_V - k.deadband_v) / k.volts_per_mps
    amplitude_m = min(speed_mps / (2 * np.pi * TOP_HZ), MOST_OF_STROKE * plant.constants.stroke_m)
    return swept_sine(plant, rng, duration_s, amplitude_m)


def grid(fine_v: float = 0.25, coarse_v: float = 0.5, dp_step_pa: float = 0.5e6) -> Grid:
    """Unequal spacing as in Fig. 4: fine from 1 to 4 V, where the dead band may end."""
    fine = np.linspace(1.0, 4.0, round(3.0 / fine_v) + 1)
    coarse = np.linspace(4.0, 9.0, round(5.0 / coarse_v) + 1)[1:]
    rows = round(9e6 / dp_step_pa) + 1
    return Grid(np.concatenate([fine, coarse]), np.linspace(0.0, 9e6, rows))


def write_boom(
    trace: Path, plant: SimulatedPlant, model: Machine, frames: Frames, more: str = ""
) -> Path:
    """Write the log and, beside it, the project file, which is returned; more: text for it."""
    write_log(trace, frames)
    project = trace.with_suffix(".toml")
    project.write_text(project_text(model, plant.constants.stroke_m, "boom") + more, "utf-8")
    return project
