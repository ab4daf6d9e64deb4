"""The boom of the paper on the simulated rig: its sweep as CAN frames, and what they teach.

The paper names neither pressures nor amplitude.  Here they are chosen so that the data lie where
its Fig. 4 and Table 1 have them: a supply of 8.5 MPa, a load that falls as the boom rises, and a
sweep that takes the command to 8.5 V.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from firmware_bridge.frames import Frames
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.published import publish
from rtid.model import Grid, Model
from rtid.project import load
from rtid.replay import Replay, replay
from rtid.sim.bus import run_frames
from rtid.sim.declare import declared_model
from rtid.sim.log import START_US, write_log
from rtid.sim.motion import Motion, swept_sine
from rtid.sim.plant import FloatArray, Plant
from rtid.sim.project_file import project_text
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate

SUPPLY_PA = 8.5e6
LOAD_SLOPE_1PM = -12e3 / 4500.0  # of the load in mid-stroke, per metre of stroke
TOP_V = 8.5  # command at the sweep's highest speed
TOP_HZ = 0.5
MOST_OF_STROKE = 0.35
SWEEP_S = 80.0
LOGS = ".blf"


@dataclass(frozen=True)
class Learned:
    """A machine, and what its frames have taught."""

    plant: Plant
    replay: Replay
    flowmap: FlowMap

    @property
    def model(self) -> Model:
        """The declaration with which it was learned."""
        return self.replay.model


def boom(number: int | None = None) -> Plant:
    """The default machine as the paper's boom, or the random machine with this number."""
    plant = Plant() if number is None else draw(number)
    slope = LOAD_SLOPE_1PM * plant.constants.gravity_n
    constants = plant.constants._replace(gravity_slope_npm=slope)
    return replace(plant, p_supply_pa=SUPPLY_PA, constants=constants)


def sweep(plant: Plant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """The paper's swept sine, 0.1 to 0.5 Hz, as far as command and stroke allow."""
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


def learn(
    plant: Plant,
    seed: int = 0,
    motion: Motion = sweep,
    duration_s: float = SWEEP_S,
    blocks: Grid | None = None,
    more: str = "",
) -> Learned:
    """Simulate, write the frames as a CAN log, replay it with the user's project file.

    blocks: of every edge's map, `grid()` if not given; more: text appended to the project file.
    """
    run = simulate(plant, motion, seed, duration_s)
    model = declared_model(plant, grid=blocks or grid(), seed=seed)
    return learn_frames(plant, model, run_frames(run, start_us=START_US), more)


def learn_frames(plant: Plant, model: Model, frames: Frames, more: str = "") -> Learned:
    """What these frames teach, as a log on the desk with the project file of this model."""
    with logged(plant, model, frames, more) as (project, trace):
        found = replay(load(project), trace)
    return Learned(plant, found, publish(found.fit.solution))


@contextmanager
def logged(
    plant: Plant, model: Model, frames: Frames, more: str = ""
) -> Iterator[tuple[Path, Path]]:
    """A project file and a log for as long as they are needed; more: text for the former."""
    with TemporaryDirectory() as folder:
        trace = Path(folder) / f"boom{LOGS}"
        yield write_boom(trace, plant, model, frames, more), trace


def write_boom(trace: Path, plant: Plant, model: Model, frames: Frames, more: str = "") -> Path:
    """Write the log and, beside it, the project file, which is returned; more: text for it."""
    write_log(trace, frames)
    project = trace.with_suffix(".toml")
    project.write_text(project_text(model, plant.constants.stroke_m, "boom") + more, "utf-8")
    return project
