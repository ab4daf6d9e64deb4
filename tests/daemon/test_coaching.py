"""When the coach is asked, what it is asked, and that its answer is the design's own."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from rtid.daemon import diagnosing, jobs
from rtid.daemon.coaching import Coaching, by_valve
from rtid.daemon.diagnoser import answer
from rtid.daemon.status import EdgeHealth
from rtid.estimator.estimator import Estimator
from rtid.excite import library
from rtid.project import Project, load
from rtid.sim.run import simulate
from rtid.trace.snapshot import Generations
from tests.command import in_json
from tests.excite.machines import machine, write_project
from tests.replays import shared_replays  # noqa: F401

NUMBER, LEAK = 7, "external_leakage_laminar"


class Remembering:
    """A helper that only remembers, and is remembered in `made`."""

    made: ClassVar[list[Remembering]] = []

    def __init__(self, *_: object) -> None:
        self.made.append(self)
        self.jobs: list[jobs.Job] = []
        self.is_stopped = False
        self.put: Callable[[jobs.Job], None] = self.jobs.append

    def stop(self, _timeout_s: float) -> None:
        self.is_stopped = True


@pytest.fixture
def project(tmp_path: Path) -> Project:
    return load(write_project(tmp_path, machine(NUMBER), NUMBER, see=f'["{LEAK}"]'))


def learned(project: Project, folder: Path, seconds: float) -> Estimator:
    """What a machine has taught, with a snapshot in the folder."""
    estimator = Estimator(project.model)
    estimator.update(simulate(machine(NUMBER), "rich", 1, seconds).samples)
    Generations(folder, project.digest).save(estimator)
    return estimator


def test_the_coach_is_asked_once_there_is_a_snapshot_and_now_and_then(
    project: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnosing, "Helper", Remembering)
    made = list[Remembering]()
    monkeypatch.setattr(Remembering, "made", made)
    folder = Generations(tmp_path, project.digest).folder
    coach = Coaching(project, folder, lambda _: None)
    coach.look(Estimator(project.model))
    assert not made, "nothing is saved yet"
    estimator = learned(project, tmp_path, 4.0)
    coach.look(estimator)
    coach.look(estimator)
    (helper,) = made
    (job,) = helper.jobs
    assert isinstance(job, jobs.Coach) and Path(job.snapshot).exists()
    assert len(job.chunk) > 3000, "an effect is to be seen"
    coach.take(jobs.Coached(None, "no reason"))
    assert helper.is_stopped and coach.advice is None
    coach.look(estimator)
    assert len(made) == 1, "it is not time yet"
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 601.0)
    coach.look(estimator)
    assert len(made) == 2
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 601.0 + 901.0)
    coach.look(estimator)
    assert made[1].is_stopped and not coach.is_running, "it has taken too long"


@pytest.mark.long
@pytest.mark.slow
def test_the_coach_says_what_excite_after_the_same_snapshot_says(
    project: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(library, "PACES", (0.3, 0.5))
    monkeypatch.setattr(library, "SWINGS", ((0.65, 1.0),))
    monkeypatch.setattr(library, "STEPS", ((0.5, 0.07),))
    monkeypatch.setattr(library, "PASS_STEPS", ((0.5, 0.07),))
    monkeypatch.setattr(library, "ZIGZAGS", (0.3,))
    learned(project, tmp_path, 4.0)
    snapshot = next(tmp_path.glob("*/state-*.npz"))
    told = answer(jobs.Coach(str(snapshot), np.empty((0, 0))), project)
    assert isinstance(told, jobs.Coached) and told.advice is not None, told
    advice = told.advice
    assert advice.blocks and set(advice.blocks) <= {edge.name for edge in project.model.edges}
    assert f"{LEAK} (a)" in advice.effects
    assert 0 < len(advice.segments) <= 3
    found = in_json("excite", "-p", project.path, "--after", snapshot, "--no-compare")
    worth, tried = found["segments_worth_running"], found["segments_tried"]
    assert f"{worth} of {tried} pieces" in advice.text


def test_a_coach_that_cannot_says_why(project: Project, tmp_path: Path) -> None:
    told = answer(jobs.Coach(str(tmp_path / "state-0.npz"), np.empty((0, 0))), project)
    assert isinstance(told, jobs.Coached) and told.advice is None and "state-0" in told.reason


def test_without_limits_the_valve_that_is_known_least_is_named(project: Project) -> None:
    some = EdgeHealth("pa", {"valid": 30, "learning": 12}, {}, 0.7)
    poor = EdgeHealth("pb", {"valid": 3, "learning": 5}, {}, 0.2)
    advice = by_valve(project.model, [some, poor])
    assert advice is not None and advice.blocks == {"pb": 5}
    assert "Valve pb knows least. Move with negative u" in advice.text
    assert by_valve(project.model, []) is None
