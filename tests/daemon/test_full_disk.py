"""A disk that is really full: a small file system, mounted for the test."""

from __future__ import annotations

import fcntl
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from firmware_bridge.sources import open_log
from rtid.daemon import jobs, realtime
from rtid.daemon import status as st
from rtid.daemon.analyst import Analyst, _receive
from rtid.daemon.helper import Helper
from rtid.daemon.jobs import Waiting
from rtid.daemon.recorder import MOST_SEGMENTS, RETRY_S, Recorder
from rtid.daemon.teller import Saving
from rtid.trace import state_files
from rtid.trace.snapshot import Generations
from tests.daemon.disk import fill, mounted
from tests.daemon.test_parts import Clock, frames
from tests.faults.harness import machine

ROOM = 1 << 20


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of ROOM bytes."""
    with mounted(tmp_path / "disk", ROOM) as folder:
        yield folder


def status(text: str = "") -> st.Status:
    loop, bus = st.LoopHealth(1000.0), st.BusHealth("virtual", "none")
    store = st.Store("NOT SAVED" if text else "saved", text)
    return st.Status("machine", 1, 0.0, 0.0, loop, bus, store=store)


def test_the_status_has_its_room_on_a_full_disk(disk: Path) -> None:
    for _ in range(2):
        st.write(disk, status())
    fill(disk)
    for k in range(50):
        fill(disk)  # others take whatever becomes free
        text = f"NOT SAVED: no room, {k} " + "and more of it " * k
        st.write(disk, status(text))
        assert st.read(disk).store.reason == text


def test_a_status_that_outgrows_its_room_leaves_the_old_one_whole(disk: Path) -> None:
    for _ in range(2):
        st.write(disk, status("small"))
    fill(disk)
    with pytest.raises(OSError, match="No space"):
        st.write(disk, status("x" * 100_000))
    assert st.read(disk).store.reason == "small"
    (disk / "filler").unlink()
    st.write(disk, status("x" * 100_000))
    assert len(st.read(disk).store.reason) == 100_000


def test_a_reader_never_sees_half_a_status(tmp_path: Path) -> None:
    st.write(tmp_path, status())
    stop, wrong = threading.Event(), list[str]()

    def look() -> None:
        while not stop.is_set():
            try:
                reason = st.read(tmp_path).store.reason
            except st.StatusError as error:
                reason = str(error)
            if len(set(reason)) > 1:
                wrong.append(reason)

    reader = threading.Thread(target=look)
    reader.start()
    for k in range(300):
        st.write(tmp_path, status("ab"[k % 2] * (20 + 37 * k % 5000)))
    stop.set()
    reader.join()
    assert not wrong


def test_what_a_reader_has_open_is_not_written_over(tmp_path: Path) -> None:
    """Nor does one that hangs hold up the status."""
    for _ in range(2):
        st.write(tmp_path, status())
    with state_files.opened(tmp_path / st.STATUS_FILE) as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        content = file.read()
        for text in ("one", "two", "three"):
            st.write(tmp_path, status(text))
            assert st.read(tmp_path).store.reason == text
        file.seek(0)
        assert file.read() == content


def test_a_lock_that_a_stranger_keeps_holds_up_no_reader(tmp_path: Path) -> None:
    st.write(tmp_path, status("one"))
    with state_files.opened(tmp_path / st.STATUS_FILE) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert st.read(tmp_path).store.reason == "one"


def test_where_names_cannot_be_exchanged_the_new_file_replaces_the_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_files, "_libc", lambda: None)
    for text in ("one", "two", "three"):
        st.write(tmp_path, status(text))
        assert st.read(tmp_path).store.reason == text
    assert [path.name for path in tmp_path.iterdir()] == [st.STATUS_FILE]


def test_a_disk_without_room_is_told_before_a_save_fails(disk: Path) -> None:
    saving = Saving(30.0, disk)
    snapshot = disk / "state.npz"
    snapshot.write_bytes(bytes(300_000))
    saving.hear(jobs.SavedSnapshot(1, str(snapshot), time.monotonic()))
    assert saving.why_not(True) == ""
    (disk / "other").write_bytes(bytes(600_000))
    assert "a snapshot needs 292 KB" in saving.why_not(True)
    assert saving.store(saving.why_not(True), "", "", 0).state == "NOT SAVED"
    assert saving.why_not(False) == "", "nothing is learned that could be lost"
    (disk / "other").unlink()
    assert saving.why_not(True) == ""
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    assert "is read-only" in saving.why_not(True)


def test_what_was_not_to_be_saved_is_not_missed_when_learning_begins_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A changed machine is accepted after a minute in which nothing was stored on purpose."""
    clock = {"now_s": 1000.0}
    monkeypatch.setattr(time, "monotonic", lambda: clock["now_s"])
    saving = Saving(30.0, tmp_path, started_s=1000.0)

    def said(now_s: float, is_learning: bool) -> str:
        clock["now_s"] = now_s
        return saving.why_not(is_learning)

    assert not any(said(now_s, False) for now_s in (1020.0, 1050.0, 1080.0))
    assert not any(said(now_s, True) for now_s in (1081.0, 1120.0))
    assert said(1126.0, True) == "NOT SAVED: no snapshot for 46 s"


def test_the_recorder_makes_no_files_on_a_full_disk(disk: Path) -> None:
    """Five batches a second for a minute: it tries again now and then, and leaves nothing."""
    clock = Clock()
    recorder = Recorder(disk, 100 << 20, clock)
    recorder.write(frames(0.2, 0.0))
    folder = Path(recorder.keep("alarm", clock.now_s))
    fill(disk)
    refused = 0
    for k in range(300):
        clock.now_s += 0.2
        fill(disk)
        try:
            recorder.write(frames(0.2, 1.0 + 0.2 * k))
        except OSError:
            refused += 1
    assert refused >= 299  # the last page of the segment may have room for one more
    ring = list((disk / "recording").glob("*.blf"))
    assert len(ring) == 1 and len(list(folder.iterdir())) == 1
    assert all(path.stat().st_size > 1000 for path in ring)
    (disk / "filler").unlink()
    clock.now_s += RETRY_S
    recorder.write(frames(0.2, 100.0))
    recorder.close()
    assert len(open_log(Path(ring[0]))) >= 200


def test_a_batch_that_the_disk_takes_a_part_of_is_refused(disk: Path) -> None:
    recorder = Recorder(disk, 100 << 20, Clock())
    with pytest.raises(OSError, match="No space"):
        for k in range(1000):
            recorder.write(frames(1.0, float(k)))


def test_the_ring_is_limited_in_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that steps begins a segment each time; small ones never reach the limit of bytes."""
    assert MOST_SEGMENTS <= 10_000
    monkeypatch.setattr("rtid.daemon.recorder.MOST_SEGMENTS", 20)
    recorder = Recorder(tmp_path, 100 << 20, Clock())
    for k in range(50):
        recorder.write(frames(0.01, 1000.0 * k))
    recorder.close()
    assert len(list((tmp_path / "recording").glob("*.blf"))) == 20


def batch(seconds: float = 0.2) -> jobs.Batch:
    return jobs.Batch(np.zeros((round(1000 * seconds), 10)), None)


def test_a_snapshot_passes_a_queue_behind_a_solve() -> None:
    """The helper takes two minutes of batches from its pipe, and saves, while nothing is done."""
    handover = jobs.Handover(7, None, publish=False, store=True)  # type: ignore[arg-type]
    items: list[jobs.Job | None] = [*(batch() for _ in range(600)), handover, None]
    saved, ended, waiting = list[int](), list[int](), Waiting(16 << 20)

    class FromPipe:
        def receive(self) -> jobs.Job | None:
            return items.pop(0)

    class Saver:
        def save(self, job: jobs.Handover) -> None:
            saved.append(job.number)

    thread = threading.Thread(
        target=_receive,
        args=(FromPipe(), Saver(), waiting, lambda: ended.append(saved[-1])),
        daemon=True,
    )
    thread.start()
    thread.join(10.0)
    assert saved == ended == [7] and not thread.is_alive()
    taken = 0
    while waiting.get() is not None:
        taken += 1
    assert taken == 601 and waiting.empty()


def test_what_waits_in_the_helper_is_bounded_in_bytes() -> None:
    waiting = Waiting(3 * batch().size_bytes)
    for _ in range(3):
        waiting.put(batch(), timeout=0.1)
    assert waiting.full()
    waiting.get()
    assert not waiting.full()


def test_what_must_be_on_the_disk_goes_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Helper, "_run", lambda self: None)
    helper = Helper("none", [], lambda answer: None)
    for _ in range(100):
        helper.put(batch())
    urgent = jobs.Handover(3, None, publish=False, store=True)  # type: ignore[arg-type]
    helper.put(urgent, first=True)
    assert helper._next() is urgent and helper.queued == 100


def test_what_is_to_be_saved_hastens_the_helper(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its main thread, which may hold the interpreter, and before it is sent."""
    done = list[str]()
    monkeypatch.setattr(Helper, "_run", lambda self: None)
    monkeypatch.setattr(realtime, "hasten", lambda *what: done.append(f"hastens {what}"))
    pipe = SimpleNamespace(send=lambda job: done.append(type(job).__name__))
    helper = Helper("none", [], lambda answer: None)
    helper.put(batch())
    helper.put(jobs.Handover(3, None, publish=False, store=True))  # type: ignore[arg-type]
    helper._stopping = True
    helper._feed(pipe, SimpleNamespace(pid=77))  # type: ignore[arg-type]
    assert done == ["Batch", "hastens (77, False)", "Handover", "NoneType"]


def test_a_thread_is_hastened_for_a_while() -> None:
    """Where the system grants it, and no thread beside it."""
    thread = threading.get_native_id()
    before = os.getpriority(os.PRIO_PROCESS, thread)
    with realtime.hastened():
        meanwhile = os.getpriority(os.PRIO_PROCESS, thread)
    assert meanwhile in (before, realtime.HASTY)
    assert os.getpriority(os.PRIO_PROCESS, thread) == before


def test_a_thread_that_is_hastened_gives_way_again() -> None:
    """Beside a loop of real-time priority, where that is granted; another thread is not asked."""
    found = list[tuple[int, int]]()

    def seen(thread: int) -> None:
        policy = os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK
        found.append((policy, os.getpriority(os.PRIO_PROCESS, thread)))

    def run() -> None:
        thread = threading.get_native_id()
        seen(thread)
        realtime.hasten(thread, is_real_time=True)
        seen(thread)
        realtime.give_way(thread, found[0][1])
        seen(thread)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    policy, nice = found[0]
    assert found[2] == found[0]
    assert found[1][0] in (policy, os.SCHED_RR) and found[1][1] in (nice, realtime.HASTY)


def test_what_was_overtaken_does_not_replace_what_is_newer(tmp_path: Path) -> None:
    """What must be on the disk goes ahead of a snapshot that waits, and a restart has it."""
    heard: list[jobs.Answer] = []
    analyst = Analyst(machine().project, tmp_path, heard.append)
    learner = machine().learner()
    handed = []
    for number, part in enumerate(machine().frames[:6000].chunks(3000), 1):
        learner.push(part)
        handed.append(
            jobs.Handover(number, learner.estimator.copy(with_history=False), False, True)
        )
    for handover in reversed(handed):
        analyst.save(handover)
    found = Generations(tmp_path, machine().project.digest).restore(machine().project.model)
    assert found.estimator is not None
    assert found.estimator.counters["samples"] == learner.estimator.counters["samples"]
    assert [a.number for a in heard if isinstance(a, jobs.SavedSnapshot)] == [2]
    assert sum(isinstance(answer, jobs.Ready) for answer in heard) == 2
    analyst.close()


def test_a_status_keeps_its_meaning_with_room_behind_it(tmp_path: Path) -> None:
    st.write(tmp_path, status())
    text = (tmp_path / st.STATUS_FILE).read_text()
    assert len(text) % st.ROOM_BYTES == 0 and st.from_json(text) == replace(status())


def test_a_snapshot_on_the_disk_says_nothing_of_the_history(tmp_path: Path) -> None:
    """Each refusal stands until the disk has taken that very thing."""
    heard: list[jobs.Answer] = []
    analyst = Analyst(machine().project, tmp_path, heard.append)
    saving = Saving(30.0, tmp_path)
    (tmp_path / "history.sqlite").mkdir()  # nothing can be written there
    note = jobs.Note(st.Alarm("x", "y", 1e9, None, "bus"), keep=False)
    estimator = machine().learned(machine().frames[:3000]).estimator

    def done() -> set[str]:
        analyst.take(note)
        analyst.save(jobs.Handover(1, estimator.copy(with_history=False), False, True))
        for answer in heard:
            if isinstance(answer, jobs.SavedSnapshot | jobs.NotSaved | jobs.SavedAgain):
                saving.hear(answer)
        heard.clear()
        return set(saving.refused)

    assert done() == {"history"} and saving.saved_s is not None
    assert "NOT SAVED: history" in saving.why_not(True)
    (tmp_path / "history.sqlite").rmdir()
    assert done() == set() and saving.why_not(True) == ""
    analyst.close()
