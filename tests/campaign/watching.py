"""The plant watch away from the clock: a handover each 10 s, judgements as the analyst has them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from rtid.daemon.jobs import Handover
from rtid.daemon.map_check import Judge
from rtid.daemon.plant_watch import PlantWatch
from rtid.project import load
from rtid.sim.bus import run_frames
from rtid.sim.recording import write_run
from rtid.sim.run import PlantChange, simulate
from rtid.sim.run_files import START_US
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.described import catalog_of
from rtid.trace.learner import Learner

PUBLISH_S, PIECE = 10.0, 600  # frames: 0.2 s, as the loop hands them over


@dataclass(frozen=True)
class Watched:
    """alarm_s: time of the first alarm, None without; judged_s: of motion that could have one."""

    alarm_s: float | None
    judged_s: float
    worst: float  # largest surprise over its level, of those that were judged


def watched(
    plant: SimulatedPlant,
    seed: int,
    seconds: float,
    motion: str = "rich",
    change: PlantChange | None = None,
) -> Watched:
    """A plant under the watch, until its first alarm or the end."""
    run = simulate(plant, motion, seed, seconds, change=change)
    with TemporaryDirectory() as folder:
        trace = Path(folder) / "machine.blf"
        write_run(trace, simulate(plant, motion, seed, 1.0), seed, motion)
        project = load(trace.with_suffix(".toml"))
        learner = Learner(project.model, catalog_of(project), project.assembly)
    watch, judge, number, next_s = PlantWatch(), None, 0, PUBLISH_S
    judged_s = worst = 0.0
    for piece in run_frames(run, start_us=START_US).chunks(PIECE):
        chunk = learner.push(piece)
        if judge is not None and (one := judge.push(chunk)) is not None:
            level, before_s = watch.level, judged_s
            changed = watch.push(one)
            if watch.is_ready:
                judged_s, worst = before_s + 1.0, max(worst, one.surprise / level)
            if changed:
                return Watched(one.t_s, judged_s, worst)
        if len(chunk) and chunk[-1, 0] >= next_s:
            next_s, number = next_s + PUBLISH_S, number + 1
            handover = Handover(
                number, learner.estimator.copy(with_history=False), publish=True, store=False
            )
            judge = Judge(handover, handover.estimator.solution())
    return Watched(None, judged_s, worst)
