"""The daemon's own loop, keeper and analyst in simulated time: restarts, faults, kills.

No bus, no process and no clock: frames come in pieces of 0.2 s, every job is done at once.
"""

from __future__ import annotations

import math
import os
import shutil
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from firmware_bridge import frames as fr
from firmware_bridge.catalog import Catalog
from firmware_bridge.frames import Frames
from rtid.daemon import jobs
from rtid.daemon.analyst import Analyst
from rtid.daemon.core import Core
from rtid.daemon.keeper import Keeper
from rtid.daemon.teller import Facts
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.solution import Solution
from rtid.plain import FloatArray
from rtid.project import Project, load
from rtid.sim.bus import run_frames
from rtid.sim.hidden import hide_wish
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import PlantChange, Run, simulate
from rtid.sim.run_files import START_US
from rtid.sim.sensing import P_A, P_B, P_S, Sensors, U, X
from rtid.sim.simulated_plant import SimulatedPlant, Valve
from rtid.trace.described import catalog_of
from rtid.trace.learner import Learner
from rtid.trace.snapshot import Generations

PIECE = 600  # frames: 0.2 s
PIECE_NS = 200_000_000
START_S = 1e-6 * START_US

Spoil = Callable[[FloatArray], FloatArray]  # of the sensors' values (n, 7), columns as NAMES


@dataclass(frozen=True)
class Fault:
    """What is wrong from some time on: with the machine, or with what its sensors say.

    names: the words of which an alarm must hold one.
    """

    names: tuple[str, ...]
    plant: Callable[[SimulatedPlant, float], SimulatedPlant] = lambda plant, _: plant
    spoil: Spoil | None = None


def leak(share: float) -> Callable[[SimulatedPlant, float], SimulatedPlant]:
    """An internal leak whose flow is, root mean square on the healthy motion, a share of rated."""
    return lambda plant, rate: replace(
        plant, extra=plant.extra._replace(internal_laminar=share * rate)
    )


def _scaled(column: int, factor: float, offset: float = 0.0) -> Spoil:
    def spoil(values: FloatArray) -> FloatArray:
        changed = values.copy()
        changed[:, column] = factor * values[:, column] + offset
        return changed

    return spoil


def _turned(values: FloatArray) -> FloatArray:
    """The position counted from the other end of its sensor."""
    changed = values.copy()
    changed[:, X] = Sensors.x_range_m - values[:, X]
    return changed


def _swapped(values: FloatArray) -> FloatArray:
    changed = values.copy()
    changed[:, [P_A, P_B]] = values[:, [P_B, P_A]]
    return changed


def _air(plant: SimulatedPlant, _rate: float) -> SimulatedPlant:
    return replace(plant, extra=plant.extra._replace(air_share=0.02))


FAULTS = {
    "leak of 2 %": Fault(("leak",), leak(0.02)),
    "leak of 10 %": Fault(("leak",), leak(0.1)),
    "air, 2 %": Fault(("air",), _air),
    "pressures swapped": Fault(("p_a and p_b are swapped",), spoil=_swapped),
    "u reversed": Fault(
        ("u has the wrong sign", "the machine moves against u:"), spoil=_scaled(U, -1.0)
    ),
    "x reversed": Fault(
        ("x has the wrong sign", "x runs against command and pressures:"), spoil=_turned
    ),
    "p_b 10 % too much": Fault(("p_b reads",), spoil=_scaled(P_B, 1.1)),
    "p_a 2 bar too much": Fault(("p_a reads",), spoil=_scaled(P_A, 1.0, 2e5)),
    "p_supply stuck": Fault(("p_supply",), spoil=lambda values: _stuck(values, P_S)),
}


def _stuck(values: FloatArray, column: int) -> FloatArray:
    changed = values.copy()
    changed[:, column] = values[0, column]
    return changed


def machine_of(seed: int) -> SimulatedPlant:
    """A machine drawn at random; each third one has another law of its valves."""
    plant = draw(seed)
    if seed % 3 == 1:  # flow that hardly depends on the pressure
        return hide_wish(plant, "load_compensated_valve=0.5")
    if seed % 3 == 2:  # straighter spools without ripple
        return replace(plant, valves=tuple(_plain(valve) for valve in plant.valves))
    return plant


def _plain(valve: Valve) -> Valve:
    return replace(valve, ripple=0.0, curve_1pv=0.06)


def oil(plant: SimulatedPlant, warmer_k: float) -> SimulatedPlant:
    """The machine with warmer oil: softer, thinner, lighter."""
    c, thinner = plant.constants, float(np.exp(-0.035 * warmer_k))
    constants = c._replace(
        beta_pa=c.beta_pa * (1 - 0.005 * warmer_k),
        viscous_nspm=c.viscous_nspm * thinner,
        dp_laminar_pa=c.dp_laminar_pa * thinner**2,
    )
    valves = tuple(replace(v, gain=v.gain * (1 + 0.00035 * warmer_k)) for v in plant.valves)
    return replace(plant, constants=constants, valves=valves)


@dataclass(frozen=True)
class Bench:
    """One machine with its project; `rate`: m3/s/Pa of a leak as large as the rated flow."""

    plant: SimulatedPlant
    project: Project
    catalog: Catalog
    seed: int
    rate: float

    @classmethod
    def of(cls, folder: Path, seed: int) -> Bench:
        """Draw it, and write its project."""
        plant = machine_of(seed)
        trace, run = folder / "machine.blf", simulate(plant, "rich", seed, 10.0)
        write_run(trace, simulate(plant, "rich", seed, 1.0), seed, "rich")
        project = load(trace.with_suffix(".toml"))
        drop = run.samples.column("p_a") - run.samples.column("p_b")
        rated = max(edge.rated_q_m3s for edge in project.model.edges)
        rate = rated / float(np.sqrt(np.mean(drop**2)))
        return cls(plant, project, catalog_of(project), seed, rate)

    def publishing(self, every_s: float) -> Bench:
        """The same, whose daemon publishes that seldom: most of its time goes into it."""
        sections = self.project.sections
        daemon = sections.daemon.model_copy(update={"publish_s": every_s})
        changed = replace(self.project, sections=replace(sections, daemon=daemon))
        return replace(self, project=changed)

    def run(self, seconds: float, seed: int, motion: str = "rich", **plant: Any) -> Run:
        """A healthy run; plant: another one than its own, or a change while it runs."""
        made = plant.pop("plant", self.plant)
        return simulate(made, motion, seed, seconds, **plant)

    def faulty(self, fault: Fault, healthy_s: float, seconds: float, seed: int) -> Run:
        """A run in which a fault begins after some seconds."""
        sick = fault.plant(self.plant, self.rate)
        change = PlantChange(healthy_s, sick) if healthy_s else None
        run = simulate(sick if change is None else self.plant, "rich", seed, seconds, change=change)
        if fault.spoil is None:
            return run
        samples, begin = run.samples, round(1e3 * healthy_s)
        values = np.concatenate([samples.values[:begin], fault.spoil(samples.values[begin:])])
        return replace(run, samples=replace(samples, values=values))


class Fed:
    """A source that gives what is put into it."""

    is_down, is_over, queued = False, False, 0

    def __init__(self) -> None:
        self.waiting = fr.empty(0)

    def read(self, _timeout_s: float) -> Frames:
        """What was put there."""
        frames, self.waiting = self.waiting, fr.empty(0)
        return frames


class Beside:
    """The analyst in this process: each job is done when it is put."""

    failures = dropped = 0

    def __init__(self, analyst: Analyst) -> None:
        self._analyst = analyst

    def put(self, job: jobs.Job, first: bool = False) -> None:
        """Do it, whatever else waits."""
        if isinstance(job, jobs.Handover) and job.store:
            self._analyst.save(job)
        self._analyst.take(job)


class Simulated:
    """One start of the daemon on a state folder."""

    def __init__(self, bench: Bench, folder: Path, begin_s: float) -> None:
        project, answers = bench.project, deque[jobs.Answer]()
        self._bench, self.folder = bench, folder
        learner = Learner(project.model, bench.catalog, project.assembly)
        generations = Generations(folder, project.digest)
        self.restored = generations.restore(learner.estimator.model)
        if self.restored.estimator is not None:
            self.restored.estimator.history = learner.estimator.history
            learner.estimator = self.restored.estimator
        self.analyst = Analyst(project, folder, answers.append)
        self._source, beside = Fed(), Beside(self.analyst)
        self.core = Core(project, learner, self._source, beside)  # type: ignore[arg-type]
        nothing = SimpleNamespace(
            verdict=None, is_of_change=False, is_acquitted=False, implausible=(), is_running=False,
            look=lambda *_: None, check=lambda _: True, begin=lambda _: None, end=lambda: None,
            take=lambda _: None, published=lambda _: None, advice=None,
        )  # fmt: skip
        facts = Facts(
            project, folder, "simulated", "", self.restored.text, "other", False, time.time(), 1e9,
            generations.folder,
        )  # fmt: skip
        self.keeper = Keeper(facts, self.core, beside, nothing, nothing, answers)  # type: ignore[arg-type]
        self._now_ns = time.monotonic_ns()
        self.begin_s, self.alarm_s, self.learning_s = begin_s, float("nan"), float("nan")
        self.text = ""
        self.analyst.begin()
        answers.append(jobs.Ready())
        self.keeper._listen()

    def killed(self) -> Simulated:
        """The next start, after a kill."""
        return Simulated(self._bench, self.folder, self.begin_s + 100.0)

    @property
    def is_held(self) -> bool:
        """Whether samples are refused since a sensor is frozen."""
        return self.keeper.alarms.has("sensor_frozen")

    @property
    def published(self) -> FlowMap:
        """The map that is published now."""
        assert self.keeper.teller.publication is not None
        return self.keeper.teller.publication.flow_map

    def branched(self, folder: Path) -> None:
        """In a process that was forked: go on with a copy of the state, the working folder's."""
        shutil.copytree(".", folder)
        os.chdir(folder)
        books = self.analyst._books
        books._chronicle = books._recorder = None  # their files are the parent's

    def hear(self, run: Run, from_s: float = 0.0, to_s: float = math.inf) -> None:
        """The frames of a run, or of a part of it, from begin_s of the machine's time on.

        Behind a whole run the next one would begin 100 s later.
        """
        frames = run_frames(run, start_us=START_US + round(1e6 * self.begin_s))
        for k, piece in enumerate(frames.chunks(PIECE)):
            if not from_s <= 0.2 * k < to_s - 0.1:
                continue
            self._source.waiting = piece
            self._now_ns += PIECE_NS
            self.core.tick(self._now_ns)
            self.keeper._listen()
            self.keeper._look()
            self._note(0.2 * (k + 1))
        if math.isinf(to_s):
            self.begin_s += len(run.samples) * 1e-3 + 100.0

    def stop(self) -> None:
        """End in good order; without it the daemon was killed."""
        self.core.finish(publish=False)
        self.analyst.close()

    def _note(self, since_s: float) -> None:
        words = [a.text for a in self.keeper.alarms.on if a.kind in ("sensor", "plant")]
        if words:
            self.text = " / ".join(words)
            self.alarm_s = since_s if np.isnan(self.alarm_s) else self.alarm_s
        counts = self.core.learner.learns and not self.core.is_proving
        if counts and np.isnan(self.learning_s):
            self.learning_s = since_s

    @property
    def solution(self) -> Solution:
        """What would be gone on with."""
        return self.core.learner.estimator.solution()
