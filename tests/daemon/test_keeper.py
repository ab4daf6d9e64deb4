"""The housekeeper beside a loop that stands still: what it raises, what it takes up."""

from __future__ import annotations

import contextlib
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.apply.reach import is_running
from rtid.cli import main
from rtid.daemon import jobs
from rtid.daemon.acceptance import FILE, Acceptance, ask
from rtid.daemon.collector import LagMeter, ScopeKeeper
from rtid.daemon.core import Core
from rtid.daemon.health import Health
from rtid.daemon.keeper import BEGINS_S, Keeper
from rtid.daemon.loop import Loop
from rtid.daemon.status import Advice, read, write
from rtid.daemon.teller import Facts
from rtid.estimator.estimator import Estimator
from rtid.trace.snapshot import Generations
from rtid.trace.state_files import locked
from tests.faults.harness import machine

REQUEST = Acceptance(1e9, "an engineer", "new hoses")


@pytest.fixture
def keeper(tmp_path: Path) -> Keeper:
    """One that looks after a learner with 10 s of samples, and helpers that only remember."""
    learner, put = machine().learner(), list[Any]()
    chunk = learner.push(machine().frames[:30_000])
    core = SimpleNamespace(
        learner=learner, source=SimpleNamespace(is_down=False, is_over=False, queued=0),
        health=Health(machine().project, learner), lag=LagMeter(), frames=30_000,
        samples=len(chunk), newest_s=float(chunk[-1, 0]), busy=False, swap=None, is_proving=False,
        notifier=SimpleNamespace(tell=lambda *_: None), scope=ScopeKeeper(()),
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


@pytest.mark.parametrize(("lost", "is_on"), [
    ([50] * 6 + [0] * 6, range(5, 8)),  # over as soon as most of the last half second is well
    ([0] * 6 + [90] + [0] * 6, ()),  # one stall: an overrun with its cause, and no overload
    ([20, 0, 0] * 5, ()),
    ([0] * 6 + [6] * 5, range(8, 11)),
])  # fmt: skip
def test_overload_is_told_by_most_of_the_last_half_second(
    keeper: Keeper, lost: list[int], is_on: Sequence[int]
) -> None:
    loop = Loop(1000.0, lambda _: "")
    keeper.teller.loop = loop
    found = []
    for k, n in enumerate(lost):
        loop.total.ticks, loop.total.skipped = loop.total.ticks + 100 - n, loop.total.skipped + n
        loop.total.causes = {"late": loop.total.skipped}
        keeper._look_at_load()
        if "overload" in names(keeper) and "overload" not in keeper.alarms._gone_s:
            found.append(k)
    assert found == [*is_on]
    assert not found or "of the last 500 ticks" in keeper.alarms.all[0].text


def test_a_save_that_took_long_counts_for_the_next_ones(keeper: Keeper) -> None:
    """Each begins so much earlier; after a quick one the next may be slow again."""
    keeper._core.save_s = 0.0
    for took_s in (1.0, 0.1, 0.1):
        made_s = time.monotonic() - took_s
        keeper._answers.append(jobs.SavedSnapshot(1, "state-0.npz", made_s))
        keeper._listen()
    assert 0.64 <= keeper._core.save_s < 0.9


def test_a_snapshot_is_told_at_once(keeper: Keeper) -> None:
    """The age that is told is what a kill costs."""
    keeper._core.save_s = 0.0
    keeper._answers.append(jobs.SavedSnapshot(1, "state-0.npz", time.monotonic() - 0.5))
    keeper._listen()
    keeper._look()
    told = read(keeper._facts.folder)
    assert told.store.age_s is not None and 0.5 <= told.store.age_s < 5.0


@pytest.mark.parametrize("alarm", ["implausible", "signal_range"])
def test_a_sensor_that_cannot_be_believed_teaches_nothing(keeper: Keeper, alarm: str) -> None:
    """Learning is held from the alarm to its end; what is implausible has already been learned."""
    if alarm == "implausible":
        vars(keeper._diagnosing)["implausible"] = ("p_a and p_b are swapped",)
    else:
        keeper.alarms.set(alarm, "sensor", "x went from -1 to 9 m")
    for _ in range(2):
        keeper._look()
        assert not keeper._core.learner.learns
    recalls = [job.before_s for job in vars(keeper)["put"] if isinstance(job, jobs.Recall)]
    assert recalls == ([-np.inf] if alarm == "implausible" else [])
    vars(keeper._diagnosing)["implausible"] = ()
    keeper.alarms._on.pop(alarm)
    keeper._look()
    assert keeper._core.learner.learns


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


def test_no_hand_over_takes_the_samples_from_who_reads_them() -> None:
    """The keeper's thread reads them for an acceptance while the loop copies the estimator."""

    class Watched(Estimator):
        def __setattr__(self, name: str, value: object) -> None:
            assert name != "history", "gone for a moment"
            super().__setattr__(name, value)

    learner, put = machine().learner(), list[Any]()
    learner.push(machine().frames[:3000])
    learner.estimator.__class__ = Watched
    analyst: Any = SimpleNamespace(put=lambda job, first: put.append(job))
    source: Any = SimpleNamespace()
    core = Core(machine().project, learner, source, analyst)
    core.hand_over(publish=True, store=True)
    assert put[0].estimator.history is None and learner.estimator.history is not None


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


def laid(path: Path, what: str) -> None:
    """Something else in place of a file of the state folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if what == "fifo":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    elif what == "dangling link":
        path.symlink_to(path.with_name("nowhere"))
    elif what == "loop":
        path.symlink_to(path)
    elif what == "link to a device":
        path.symlink_to("/dev/zero")
    else:  # not to be read, but by root, to whom it is no request
        path.write_bytes(b"\0")
        path.chmod(0)


KINDS = ("fifo", "folder", "dangling link", "loop", "link to a device", "unreadable")


@pytest.mark.timeout(30)
@pytest.mark.parametrize("what", KINDS)
@pytest.mark.parametrize("name", ["accept.json", "status.json", "status.json.part", "state-0.npz"])
def test_nothing_that_lies_in_the_state_folder_stops_the_keeper(
    name: str, what: str, keeper: Keeper, tmp_path: Path
) -> None:
    """It goes on to tell; a request of a person who clears up is heard."""
    laid(tmp_path / name, what)
    asked = list[Acceptance]()
    vars(keeper)["_accept"] = asked.append
    keeper.start()
    try:
        first = keeper.status
        path = tmp_path / name
        if name == "accept.json" and what == "folder":
            wait_for(lambda: keeper._deaf != "")
            path.rmdir()
        acceptance_asked(tmp_path)
        wait_for(lambda: asked == [REQUEST])
        wait_for(lambda: keeper.status.now_unix_s > first.now_unix_s)
    finally:
        keeper.stop()
    told = keeper.status.store.reason
    assert told or read(tmp_path).pid == keeper.status.pid


def acceptance_asked(folder: Path) -> None:
    """As `rtid accept` does, once what lay there is gone."""
    wait_for(lambda: not os.path.lexists(folder / FILE))
    ask(folder, REQUEST)


def wait_for(what: Callable[[], bool], limit_s: float = 10.0) -> None:
    end_s = time.monotonic() + limit_s
    while not what():
        assert time.monotonic() < end_s, "not within the limit"
        time.sleep(0.02)


@pytest.mark.timeout(30)
@pytest.mark.parametrize("what", KINDS)
def test_nothing_in_place_of_a_snapshot_stops_a_start(what: str, tmp_path: Path) -> None:
    project = machine().project
    for name in ("state-0.npz", "state-1.npz.part"):
        laid(tmp_path / project.digest / name, what)
    generations = Generations(tmp_path, project.digest)
    assert generations.restore(project.model).estimator is None
    learner = machine().learner()
    with contextlib.suppress(OSError):  # told as NOT SAVED
        generations.save(learner.estimator)
    assert not list(tmp_path.rglob("nowhere")), "written through a link"


@pytest.mark.timeout(30)
@pytest.mark.parametrize("what", [k for k in KINDS if k != "unreadable"])
def test_no_lock_is_waited_for_or_written_through(what: str, tmp_path: Path) -> None:
    laid(tmp_path / "lock", what)
    with pytest.raises(OSError, match="lock"), locked(tmp_path / "lock", RuntimeError("held")):
        pytest.fail("locked what is no file")
    is_running(tmp_path)
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.timeout(60)
@pytest.mark.parametrize("what", KINDS)
@pytest.mark.parametrize(
    ("name", "command"),
    [("status.json", "status"), ("offer.npz", "status"), ("history.sqlite", "apply --log")],
)
def test_the_commands_read_the_state_folder_or_say_why_not(
    name: str, command: str, what: str, keeper: Keeper, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    write(tmp_path, keeper.status)
    (tmp_path / name).unlink(missing_ok=True)
    laid(tmp_path / name, what)
    words, extra = command.split(), []
    if words[0] == "apply":
        words.insert(1, str(machine().project.path))
        extra = ["--state", str(tmp_path)]
    else:
        extra = [str(tmp_path)]
    with pytest.raises(SystemExit) as end:
        main.run([*words, *extra])
    assert end.value.code in (0, 3, 4)
    said = capsys.readouterr()
    assert end.value.code != 3 or name in said.err
