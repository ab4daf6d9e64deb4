"""What the frames of the paper's boom teach: its sweep as a CAN log, replayed as on the desk."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from firmware_bridge.frames import Frames
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.published import publish
from rtid.model import Grid, Machine
from rtid.project import load
from rtid.sim.boom import SWEEP_S, grid, sweep, write_boom
from rtid.sim.bus import run_frames
from rtid.sim.declare import declared_model
from rtid.sim.demand import Motion
from rtid.sim.run import simulate
from rtid.sim.run_files import START_US
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.replay import Replay, replay

LOGS = ".blf"


@dataclass(frozen=True)
class Learned:
    """A machine, and what its frames have taught."""

    plant: SimulatedPlant
    replay: Replay
    flowmap: FlowMap

    @property
    def model(self) -> Machine:
        """The declaration with which it was learned."""
        return self.replay.model


def learn(
    plant: SimulatedPlant,
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


def learn_frames(plant: SimulatedPlant, model: Machine, frames: Frames, more: str = "") -> Learned:
    """What these frames teach, all of them: nothing is held out of a commissioning."""
    all_s = float(frames.t_us[-1] - frames.t_us[0]) / 1e6 + 1.0
    record = f"{more}\n[record]\nidentification_s = [0.0, {all_s}]\n"
    with logged(plant, model, frames, record) as (project, trace):
        replayed = replay(load(project), trace)
    return Learned(plant, replayed, publish(replayed.fit.solution))


@contextmanager
def logged(
    plant: SimulatedPlant, model: Machine, frames: Frames, more: str = ""
) -> Iterator[tuple[Path, Path]]:
    """A project file and a log for as long as they are needed; more: text for the former."""
    with TemporaryDirectory() as folder:
        trace = Path(folder) / f"boom{LOGS}"
        yield write_boom(trace, plant, model, frames, more), trace
