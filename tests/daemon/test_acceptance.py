"""A change that was accepted: the request, and what the analyst makes of it."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from rtid.daemon.acceptance import FILE, Acceptance, ask, taken, withdraw
from rtid.daemon.analyst import Analyst
from rtid.daemon.jobs import Answer, Handover, Recalled, Relearn
from rtid.estimator.estimator import Estimator
from rtid.trace.points import points_of
from tests.faults.harness import machine

REQUEST = Acceptance(1e9, "an engineer", "new hoses")


def test_a_request_is_heard_once(tmp_path: Path) -> None:
    assert taken(tmp_path) is None
    ask(tmp_path, REQUEST)
    assert taken(tmp_path) == REQUEST and taken(tmp_path) is None
    ask(tmp_path, REQUEST)
    assert withdraw(tmp_path)
    assert not withdraw(tmp_path), "somebody has heard it"
    assert taken(tmp_path) is None


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"at_unix_s": "x", "who": 1, "reason": 2}'])
def test_another_file_is_no_request(content: str, tmp_path: Path) -> None:
    (tmp_path / FILE).write_text(content)
    assert taken(tmp_path) is None and not (tmp_path / FILE).exists()


def test_the_analyst_learns_anew_and_keeps_what_was(tmp_path: Path) -> None:
    """The estimate is that of the samples since the change alone, bit for bit."""
    learner = machine().learner()
    before = learner.push(machine().frames[:15_000])
    since = learner.push(machine().frames[15_000:30_000])
    answers: list[Answer] = []
    analyst = Analyst(machine().project, tmp_path, answers.append)
    handed = learner.estimator.copy()
    handed.history = None
    analyst.save(Handover(1, handed, publish=False, store=True))
    analyst.take(Relearn(since, learner.estimator.origin_us, REQUEST))
    analyst.close()
    (found,) = (a for a in answers if isinstance(a, Recalled))
    alone = Estimator(machine().project.model)
    alone.advance(since)
    assert found.is_accepted and len(before)
    assert found.estimator.state.memory.tobytes() == alone.state.memory.tobytes()
    assert found.estimator.origin_us == learner.estimator.origin_us
    folder = tmp_path / machine().project.digest
    assert {p.name for p in folder.glob("state-*")} == {"state-0.npz"}
    assert [point.reason for point in points_of(folder)] == ["accept"]
    with sqlite3.connect(tmp_path / "history.sqlite") as history:
        rows = history.execute("SELECT who, reason FROM decision").fetchall()
    assert rows == [("an engineer", "new hoses")]
