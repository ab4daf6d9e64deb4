"""The whole story on a simulated machine: frames on a virtual bus in, flow maps out.

Nobody tells the estimator the machine's maps, bulk modulus or lag; the simulator keeps them to
itself until the end, where they are laid beside what was learned.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_bridge.playback import AS_FAST_AS_POSSIBLE
from firmware_bridge.sources import open_log
from rtid.compare import ReferenceMap
from rtid.compare.reference import GainTable
from rtid.estimator.flowmap import VALID
from rtid.estimator.solution import Solution
from rtid.model import Edge
from rtid.plain import FloatArray, Progress
from rtid.project import Project, load
from rtid.sim.hidden import hide_wish
from rtid.sim.hideable import WORN
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.compared import TraceComparison, compare_trace
from rtid.study.replay import replay
from rtid.trace.described import catalog_of
from rtid.trace.learner import Learner, listen, virtual_bus

MOTION = "rich"
WORN_MOTION, WORN_S = "rich_record", 110.0
STEP_S = 6.0  # machine time between two looks at the estimate
POINT_STEP = 10  # samples between two working points at which maps are compared


@dataclass(frozen=True)
class DemoEstimate:
    """The estimate after t_s of machine time."""

    t_s: float
    frames: int
    solution: Solution

    @property
    def valid(self) -> int:
        """Blocks known well enough to be used."""
        return sum(block.status == VALID for block in self.solution.blocks)


@dataclass(frozen=True)
class MapError:
    """Learned beside true flow of one edge, |difference| as shares of its largest flow.

    valid: share of the working points with flow that lie in valid blocks; only these count.
    """

    edge: str
    valid: float
    mean: float
    largest: float


@dataclass(frozen=True)
class Demo:
    """A simulated machine, its trace and project file in a folder."""

    plant: SimulatedPlant
    trace: Path
    project: Project
    seed: int

    def live(self, speed: float = AS_FAST_AS_POSSIBLE) -> Iterator[DemoEstimate]:
        """Learn from the virtual bus; a look at the estimate every STEP_S of machine time."""
        frames, model = open_log(self.trace), self.project.model
        learner = Learner(model, catalog_of(self.project), self.project.assembly)
        due_s = STEP_S
        with virtual_bus(frames, speed) as (source, is_over):
            for state in listen(source, learner, is_over):
                t_s = float(state.estimator.state.engine[0]["t_s"])
                if t_s >= due_s:
                    due_s = (t_s // STEP_S + 1) * STEP_S
                    yield DemoEstimate(t_s, state.frames, state.estimator.solution())

    def desk(self, progress: Progress) -> TraceComparison:
        """Replay the same trace on the desk and hold learned map and data sheet against it."""
        return compare_trace(replay(self.project, self.trace, progress), self.data_sheet())

    def data_sheet(self) -> ReferenceMap:
        """One map for all valves, as a manufacturer prints it: their mean, 4 % and 0.1 V off."""
        u_v = np.linspace(0.0, 10.0, 101)
        rng = np.random.default_rng([self.seed, 5])
        shift_v, gain = 0.1 * rng.choice([-1, 1]), 1 + 0.04 * rng.choice([-1, 1])
        flows = [
            self.plant.flow(e, u_v - shift_v, np.full(len(u_v), 1e6)) for e in self.plant.edges
        ]
        table = GainTable(u_v, np.array([1e6]), gain * np.mean(flows, axis=0)[:, None] / 1e3)
        return ReferenceMap("data sheet", {edge: table for edge in self.plant.edges})

    def map_errors(self, comparison: TraceComparison) -> list[MapError]:
        """Learned map beside the true one at the working points of the record, per edge."""
        chunk = comparison.replay.chunk[::POINT_STEP]
        return [self._map_error(edge, comparison, chunk) for edge in comparison.replay.model.edges]

    def _map_error(self, edge: Edge, comparison: TraceComparison, chunk: FloatArray) -> MapError:
        model, learned = comparison.replay.model, comparison.flowmap[edge.name]
        w = edge.direction * chunk[:, 2 + model.column(edge.command)]
        dp = chunk[:, 2 + model.column(edge.source)] - chunk[:, 2 + model.column(edge.sink)]
        open_ = w > edge.safe_band_v
        valid = np.zeros(len(w), bool)
        valid[open_] = learned.status_at(w[open_], dp[open_]) == VALID
        true = self.plant.flow(edge.name, w[valid], dp[valid])
        error = np.abs(learned.flow(w[valid], dp[valid]) - true) / np.abs(true).max(initial=1e-12)
        share = float(valid.sum() / max(1, open_.sum()))
        return MapError(edge.name, share, float(error.mean()), float(error.max(initial=0.0)))


def wear(demo: Demo) -> tuple[Path, Path]:
    """The same machine with a piston seal that has worn out, on a longer record: trace, project.

    Nobody has told the project file of the leak.
    """
    worn = hide_wish(demo.plant, WORN)
    run = simulate(worn, WORN_MOTION, demo.seed, WORN_S)
    trace, _, project = write_run(demo.trace.with_name("worn.blf"), run, demo.seed, WORN_MOTION)
    return trace, project


def prepare(folder: Path, seed: int = 1, duration_s: float = 60.0) -> Demo:
    """Draw a machine, let it move, and write its trace and project file into the folder."""
    plant = draw(seed)
    run = simulate(plant, MOTION, seed, duration_s)
    folder.mkdir(parents=True, exist_ok=True)
    trace, _, project = write_run(folder / "machine.blf", run, seed, MOTION)
    return Demo(plant, trace, load(project), seed)
