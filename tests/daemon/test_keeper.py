"""The housekeeper beside a loop that stands still: what it raises, what it takes up."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.daemon import jobs
from rtid.daemon.acceptance import Acceptance
from rtid.daemon.health import Health
from rtid.daemon.keeper import BEGINS_S, Keeper
from rtid.daemon.lag import Lag
from rtid.daemon.status import Advice
from rtid.daemon.teller import Facts
from rtid.estimator.estimator import Estimator
from rtid.loop.loop import Loop
from tests.faults.harness import machine

REQUEST = Acceptance(1e9, "an engineer", "new hoses")


@pytest.fixture
def keeper(tmp_path: Path) -> Keeper:
    """One that looks after a learner with 10 s of samples, and helpers that only remember."""
    learner, put = machine().learner(), list[Any]()
    chunk = learner.push(machine().frames[:30_000])
    core = SimpleNamespace(
        learner=learner, source=SimpleNamespace(is_down=False, is_over=False, queued=0),
        health=Health(machine().project, learner), lag=Lag(), frames=30_000, samples=len(chunk),
        newest_s=float(chunk[-1, 0]), busy=False, swap=None,
        notifier=SimpleNamespace(tell=lambda *_: None),
    )  # fmt: skip
    diagnosing = SimpleNamespace(
        verdict=None, is_of_change=False, is_acquitted=False, implausible=(), is_running=False,
        look=lambda *_: None, check=lambda _: True, begin=lambda _: None, end=lambda: None,
    )  # fmt: skip
    coaching = SimpleNamespace(
        advice=Advice(1e9, "go on"), look=put.append, published=put.append, take=put.append,
    )  # fmt: skip
    analyst = SimpleNamespace(put=put.append, failures=0, dropped=0)
    long_ago = time.time() - 2 * BEGINS_S
    facts = Facts(machine().project, tmp_path, "x", "y", "", "other", False, long_ago, 1e9)
    made: Keeper = Keeper(
        facts, core, analyst, diagnosing, coaching, deque()  # type: ignore[arg-type]
    )  # fmt: skip
    vars(made)["put"] = put
    return made


def names(keeper: Keeper) -> set[str]:
    return {alarm.name for alarm in keeper.alarms.on}


def test_a_message_that_is_silent_twice_is_an_alarm_at_once_on_file(keeper: Keeper) -> None:
    keeper._tell()
    keeper._look()
    assert "message_silent" in names(keeper)  # the first status was told when it was made
    text = next(a.text for a in keeper.alarms.on if a.name == "message_silent")
    assert "Pressures" in text
    assert keeper.status.has("message_silent")


def test_overload_is_told_by_the_last_half_second(keeper: Keeper) -> None:
    loop = Loop(1000.0, lambda _: "")
    keeper.teller.loop = loop
    for k in range(12):
        loop.total.ticks += 100 if k > 2 else 50
        if 0 < k <= 2:
            loop.total.overruns, loop.total.skipped = (
                loop.total.overruns + 2,
                loop.total.skipped + 48,
            )
            loop.total.causes = {"late": loop.total.overruns}
        keeper._look_at_load()
        is_on = "overload" in names(keeper) and "overload" not in keeper.alarms._gone_s
        assert is_on == (1 <= k <= 6), k
    assert "50 of the last" in keeper.alarms.all[0].text


def test_an_accepted_change_is_learned_anew(keeper: Keeper) -> None:
    core = keeper._core
    keeper._accept(REQUEST)
    assert not vars(keeper)["put"], "nothing had changed"
    keeper.plant.changed, keeper.plant.since_s = True, core.newest_s - 3.0
    core.learner.learns = False
    keeper._accept(REQUEST)
    (job,) = (j for j in vars(keeper)["put"] if isinstance(j, jobs.Relearn))
    assert job.acceptance == REQUEST and job.origin_us == core.learner.estimator.origin_us
    np.testing.assert_allclose(
        job.chunk[[0, -1], 0], [core.newest_s - 3.0, core.newest_s], atol=2e-3
    )
    before = core.learner.learns
    anew = Estimator(machine().project.model)
    keeper._answers.append(jobs.Recalled(anew, is_accepted=True))
    keeper._listen()
    assert (before, core.learner.learns) == (False, True)  # once the new estimate is there
    assert core.swap is anew and not keeper.plant.changed


def test_the_coach_is_asked_while_the_machine_learns(keeper: Keeper) -> None:
    core, put = keeper._core, vars(keeper)["put"]
    core.learner.learns = False
    keeper._look()
    assert core.learner.estimator not in put
    core.learner.learns = True
    keeper._look()
    assert core.learner.estimator in put
    told = jobs.Coached(None, "no snapshot")
    keeper._answers.append(told)
    keeper._listen()
    keeper._tell()
    assert told in put and keeper.status.advice == Advice(1e9, "go on")
