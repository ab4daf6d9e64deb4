"""One simulated machine for all faults: its frames, what is learned, how far its maps drift."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.catalog import Catalog
from firmware_bridge.frames import Frames
from rtid.estimator.flowmap import VALID, EdgeMap, FlowMap
from rtid.estimator.published import publish
from rtid.estimator.solution import Solution
from rtid.plain import FloatArray
from rtid.project import Project, load
from rtid.sim.bus import run_frames
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.run_files import START_US
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.described import catalog_of
from rtid.trace.learner import Learner
from tests.faults.sender import PAUSE_S
from tests.left import shared_folder

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
    run = simulate(SimulatedPlant(), "rich", seed=1, duration_s=SECONDS)
    trace = shared_folder("rtid-faults-") / "machine.blf"
    write_run(trace, run, 1, "rich")
    project = load(trace.with_suffix(".toml"))
    return Machine(trace, project, catalog_of(project), run_frames(run, start_us=START_US))


@cache
def fault_free() -> Solution:
    """What is learned without any fault."""
    return machine().learned(machine().frames).estimator.solution()


def loop(k: int) -> Frames:
    """The k-th time that the minute is sent."""
    again = machine().frames[:]
    return replace(again, t_us=again.t_us + round(k * (SECONDS + PAUSE_S) * 1e6))


def drift(clean: Solution, faulty: Solution) -> float:
    """Relative L2 change of the published flow map over the blocks that `clean` has identified.

    Where `faulty` has not identified one of them, what it publishes there counts.
    """
    return map_drift(_published(clean), publish(faulty))


def map_drift(clean: FlowMap, other_map: FlowMap) -> float:
    """The same of two published maps.

    |Q' - Q| / |Q| with |Q|^2 the integral of Q(u, dp)^2 over the identified blocks of all edges
    (Gauss, 4 by 4 points each).
    """
    change = total = cells = 0.0
    for mine, other in zip(clean.edges, other_map.edges, strict=True):
        w_v, dp_pa, area = _points(mine)
        before = mine.flow(w_v, dp_pa)
        change += float((area * (other.flow(w_v, dp_pa) - before) ** 2).sum())
        total += float((area * before**2).sum())
        cells += len(area)
    assert cells > 150, f"only {cells:g} blocks are identified"
    return float(np.sqrt(change / total))


def _points(edge: EdgeMap) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gauss points w_v and dp_pa of the identified blocks, and their areas (blocks, 4, 4)."""
    i, j = np.nonzero(edge.status == VALID)
    at, weight = np.polynomial.legendre.leggauss(4)

    def along(border: FloatArray, k: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        middle, half = 0.5 * (border[k] + border[k + 1]), 0.5 * (border[k + 1] - border[k])
        return middle[:, None] + half[:, None] * at, half[:, None] * weight

    (w, by_w), (dp, by_dp) = along(edge.grid.u_v, i), along(edge.grid.dp_pa, j)
    w_v, dp_pa = np.broadcast_arrays(w[:, :, None], dp[:, None, :])
    return w_v, dp_pa, by_w[:, :, None] * by_dp[:, None, :]


_MAPS: dict[int, tuple[Solution, FlowMap]] = {}


def _published(solution: Solution) -> FlowMap:
    """The map, kept with its solution: to publish takes seconds."""
    if id(solution) not in _MAPS:
        _MAPS[id(solution)] = solution, publish(solution)
    return _MAPS[id(solution)][1]


def without(frames: Frames, lost: NDArray[np.bool_]) -> Frames:
    """The frames but those that are marked (n,)."""
    return frames[~lost]


def at_s(frames: Frames) -> NDArray[np.float64]:
    """Time of each frame since the first, s."""
    return np.asarray((frames.t_us - frames.t_us[0]) * 1e-6)
