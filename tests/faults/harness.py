"""One simulated machine for all faults: its frames, what is learned, how far its maps drift."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.catalog import Catalog
from firmware_bridge.frames import Frames
from rtid.estimator.blocks import VALID
from rtid.estimator.solution import Solution
from rtid.live import Learner
from rtid.project import Project, load
from rtid.replay import catalog_of
from rtid.sim.bus import run_frames
from rtid.sim.log import START_US
from rtid.sim.plant import Plant
from rtid.sim.recording import write_run
from rtid.sim.run import simulate

SECONDS = 60.0
FRAMES_PER_CYCLE = 3


@dataclass(frozen=True)
class Machine:
    """A recorded machine: its project, the DBC, and SECONDS of frames at 1 kHz."""

    trace: Path
    project: Project
    catalog: Catalog
    frames: Frames

    def learner(self) -> Learner:
        """One that has seen nothing."""
        return Learner(self.project.model, self.catalog, self.project.assembly)

    def learned(self, frames: Frames, chunk: int = 3000) -> Learner:
        """One that has taken these frames, in pieces as they might arrive."""
        learner = self.learner()
        for part in frames.chunks(chunk):
            learner.push(part)
        learner.finish()
        return learner


@cache
def machine() -> Machine:
    """The one that all tests of a session share."""
    run = simulate(Plant(), "rich", seed=1, duration_s=SECONDS)
    trace = Path(mkdtemp(prefix="rtid-faults-")) / "machine.blf"
    write_run(trace, run, 1, "rich")
    project = load(trace.with_suffix(".toml"))
    return Machine(trace, project, catalog_of(project), run_frames(run, start_us=START_US))


@cache
def fault_free() -> Solution:
    """What is learned without any fault."""
    return machine().learned(machine().frames).estimator.solution()


def drift(clean: Solution, faulty: Solution) -> float:
    """Relative L2 change of the flows over the blocks that both have identified."""
    before, after = [], []
    for block in clean.blocks:
        other = faulty.block(block.edge, block.i, block.j)
        if block.status == VALID and other is not None and other.status == VALID:
            before.append(block.mean_phi @ block.theta)
            after.append(block.mean_phi @ other.theta)
    a, b = np.array(before), np.array(after)
    assert len(a) > 50, f"only {len(a)} blocks are identified in both"
    return float(np.linalg.norm(b - a) / np.linalg.norm(a))


def without(frames: Frames, lost: NDArray[np.bool_]) -> Frames:
    """The frames but those that are marked (n,)."""
    return frames[~lost]


def at_s(frames: Frames) -> NDArray[np.float64]:
    """Time of each frame since the first, s."""
    return np.asarray((frames.t_us - frames.t_us[0]) * 1e-6)
