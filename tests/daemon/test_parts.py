"""Parts of the daemon alone: alarms, recordings, plant watch, lag, logs, metrics, helpers."""

from __future__ import annotations

import logging
import os
import sqlite3
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources import open_log
from rtid.daemon import log, metrics, status
from rtid.daemon.alarms import Alarms
from rtid.daemon.chronicle import Chronicle
from rtid.daemon.collector import Collector, LagMeter
from rtid.daemon.diagnosing import newest
from rtid.daemon.helper import Helper
from rtid.daemon.jobs import Answer, Batch, HandoverJudgement, Publication, Ready
from rtid.daemon.pipe import Pipe, pair
from rtid.daemon.plant_watch import PlantWatch
from rtid.daemon.recorder import Recorder
from rtid.daemon.status import Alarm, BusHealth, ChamberStatus, EstimateStatus, LoopHealth, Status
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.ring import History

START_US = 1_700_000_000_000_000


def frames(seconds: float, start_s: float = 0.0) -> Frames:
    n = round(1000 * seconds)
    found = fr.empty(n)
    found.t_us[:] = START_US + round(1e6 * start_s) + 1000 * np.arange(n)
    found.can_id[:], found.length[:] = 0x121, 8
    found.data[:] = np.arange(8 * n, dtype=np.uint8).reshape(n, 8)
    return found


class Clock:
    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def test_an_alarm_is_told_once_when_it_begins_and_once_when_it_is_over() -> None:
    told: list[Alarm] = []
    clock = Clock()
    alarms = Alarms(told.append, clock)
    for _ in range(5):
        alarms.put("a", "bus", "text")
    assert [a.until_unix_s for a in told] == [None]
    alarms.put("a", "bus", "")  # gone, but it may come back at once
    clock.now_s += 0.5
    alarms.put("a", "bus", "text")
    assert len(told) == 1
    alarms.put("a", "bus", "")
    clock.now_s += 1.5
    alarms.put("a", "bus", "")
    assert told[1].until_unix_s == 1000.5 and not alarms.on
    assert alarms.all == (told[1],)


def test_the_trace_of_an_alarm_is_kept_whole(tmp_path: Path) -> None:
    """The ring goes on and is limited; what belongs to the alarm stays, and is readable."""
    clock = Clock()
    recorder = Recorder(tmp_path, 400_000, clock)
    for k in range(240):  # 4 minutes
        recorder.write(frames(1.0, k))
        clock.now_s += 1.0
        if k == 100:
            kept = recorder.keep("leak", clock.now_s)
    recorder.close()
    ring = sum(path.stat().st_size for path in (tmp_path / "recording").glob("*.blf"))
    assert ring <= 400_000
    found = fr.concatenate([open_log(path) for path in sorted(Path(kept).glob("*.blf"))])
    seconds = (found.t_us - START_US) * 1e-6
    assert not found.refused
    assert seconds.min() <= 60 and seconds.max() >= 129


def test_a_recording_that_nobody_closed_is_read_to_its_end(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, 10_000_000)
    for k in range(5):
        recorder.write(frames(1.0, k))
    found = open_log(Path(recorder.path))
    assert len(found) == 5000 and not found.refused
    expected = fr.concatenate([frames(1.0, k) for k in range(5)])
    assert (found.t_us == expected.t_us).all() and (found.data == expected.data).all()


def test_a_clock_that_steps_begins_another_segment(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, 10_000_000)
    for start_s in (0.0, 1.0, 5000.0, 5001.0, 10.0):
        recorder.write(frames(1.0, start_s))
    recorder.close()
    found = [open_log(path) for path in sorted((tmp_path / "recording").glob("*.blf"))]
    assert sum(map(len, found)) == 5000 and len(found) == 3


def watch(surprises: list[float]) -> list[tuple[float, bool]]:
    plant, events = PlantWatch(), []
    for k, surprise in enumerate(surprises):
        if plant.push(HandoverJudgement(1 + k // 10, surprise, 1000, float(k))):
            events.append((float(k), plant.changed))
    return events


def test_a_plant_that_changes_is_noticed_and_that_it_is_well_again() -> None:
    healthy = [1.5, 1.2, 2.0, 1.7, 1.4] * 6
    assert watch(healthy + [8.0] * 6 + healthy) == [(34.0, True), (45.0, False)]


def test_single_surprises_and_a_slow_drift_are_no_change() -> None:
    healthy = [1.5, 1.2, 2.0, 12.0, 1.4] * 8
    assert watch(healthy) == []
    assert watch([float(x) for x in np.linspace(1.2, 6.0, 600)]) == []


def test_what_the_guard_of_the_good_map_answers_for_is_not_the_watchs_to_say() -> None:
    """Another oil moves the innovations far more than it moves the map."""
    plant = PlantWatch()
    for k in range(60):
        plant.push(HandoverJudgement(1, 1.5 if k < 40 else 9.0, 1000, float(k), is_guarded=True))
    assert not plant.changed
    for k in range(60, 65):
        plant.push(HandoverJudgement(1, 40.0, 1000, float(k)))
    assert plant.changed


def test_the_last_map_that_foretold_well_is_trusted() -> None:
    """A change 1 s after a handover: the map of the handover before is the safe one."""
    plant = PlantWatch()
    for k in range(30):
        plant.push(HandoverJudgement(1 + k // 10, 1.5, 1000, float(k)))
    assert plant.trusted == 3
    for k in range(30, 35):
        plant.push(HandoverJudgement(4, 9.0, 1000, float(k)))
    assert plant.changed and plant.trusted == 3
    assert plant.since_s == pytest.approx(29.0)


def test_the_age_of_a_sample_is_that_beyond_the_shortest_way() -> None:
    lag = LagMeter()
    assert lag.age_s(0) is None
    for k in range(2000):
        lag.note(5_000_000 + 10_000 * k, 10_000 * k + (200 if k % 3 else 900))
    assert lag.age_s(10_000 * 1999 + 200) == pytest.approx(0.0, abs=1e-3)
    assert lag.age_s(10_000 * 1999 + 2_000_200) == pytest.approx(2.0, abs=1e-3)


def test_batches_are_what_ticks_brought() -> None:
    collector, rng = Collector(4, with_frames=True), np.random.default_rng(0)
    chunks = [rng.random((n, 4)) for n in rng.integers(0, 40, 300)]
    pieces = list(frames(6.0).chunks(20))
    for chunk, piece in zip(chunks, pieces, strict=True):
        collector.add(chunk, piece)
    batch = collector.take()
    assert batch is not None and batch.frames is not None
    assert (batch.chunk == np.concatenate(chunks)).all()
    assert (batch.frames.t_us == frames(6.0).t_us).all()
    assert collector.take() is None


def test_rows_that_are_being_overwritten_are_left_out() -> None:
    history = History(1, 10.0, 100.0)
    t_s = 0.01 * np.arange(1500)
    for part in np.split(np.column_stack([t_s, t_s, t_s]), [1000]):
        history.append(part)
    rows = vars(history)["_rows"]
    rows[500:520, 0] = 15.0 + 0.01 * np.arange(20)  # the loop writes on while we copy
    found = newest(history, 20.0)
    assert (np.diff(found[:, 0]) > 0).all() and len(found) == 980


def test_a_flood_of_messages_is_held_back_and_counted(capsys: pytest.CaptureFixture[str]) -> None:
    log.set_up()
    for k in range(1000):
        log.logger.warning("same %d", k)
    log.logger.warning("another")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == log.BURST + 1 and "another" in lines[-1]
    gate = next(f for f in log.logger.handlers[0].filters if isinstance(f, log.FloodGate))
    gate._seen["same %d"][0] -= log.INTERVAL_S
    log.logger.warning("same %d", 1)
    assert "985 more" in capsys.readouterr().err
    log.logger.handlers.clear()
    log.logger.setLevel(logging.NOTSET)


def test_the_history_forgets_old_estimates_and_keeps_alarms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Publication(1, FlowMap(()), np.array([9e8]), np.array([1e6]), 1.0, 5.0, (), 0.1)
    now_s = time.time()
    for days in (200, 100, 0):
        monkeypatch.setattr(time, "time", lambda days=days: now_s - 86_400.0 * days)
        history = Chronicle(tmp_path)
        history.note_publication(found, ["a"])
        history.note_alarm(Alarm(f"{days}", "text", now_s - 86_400.0 * days))
        history.close()
    with sqlite3.connect(tmp_path / "history.sqlite") as database:
        assert database.execute("SELECT count(*) FROM estimate").fetchone()[0] == 2
        assert database.execute("SELECT count(*) FROM alarm").fetchone()[0] == 3


def full_status() -> Status:
    return Status(
        "boom", 7, 1.0, 2.0, LoopHealth(1000.0, 10, 1, 0, {"late": 1}), BusHealth("virtual", "x"),
        estimate=EstimateStatus(
            chambers=(ChamberStatus("a", float("nan")), ChamberStatus("b", 9e8, 1e6))
        ),
        alarms=(Alarm("x", 'a "quoted" text', 1.0),),
    )  # fmt: skip


def test_a_status_survives_its_file(tmp_path: Path) -> None:
    written = full_status()
    status.write(tmp_path, written)
    found = status.read(tmp_path)
    first = found.estimate.chambers[0]
    assert first.beta_pa is None  # JSON knows no NaN
    chambers = (replace(first, beta_pa=written.estimate.chambers[0].beta_pa),
                found.estimate.chambers[1])  # fmt: skip
    again = replace(found, estimate=replace(found.estimate, chambers=chambers))
    assert again.to_json() == written.to_json()


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"schema": 99}'])
def test_another_status_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / status.STATUS_FILE).write_text(content)
    with pytest.raises(status.StatusError):
        status.read(tmp_path)


def test_metrics_are_valid_exposition() -> None:
    text = metrics.exposition(full_status(), 0.5)
    names = [line.split()[2] for line in text.splitlines() if line.startswith("# TYPE")]
    assert len(names) == len(set(names)) and "rtid_overruns_total" in names
    for line in text.splitlines():
        if not line.startswith("#"):
            float(line.rsplit(" ", 1)[1])
    assert 'rtid_bulk_modulus_pascals{machine="boom",chamber="b"} 900000000' in text


@pytest.fixture
def echo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A helper module that says Ready, answers every batch by Ready, and dies of a 13-row batch."""
    (tmp_path / "echo_helper.py").write_text(
        "import os, sys\n"
        "from rtid.daemon.pipe import Pipe\n"
        "from rtid.daemon.jobs import Ready\n"
        "pipe = Pipe(int(sys.argv[1]))\n"
        "while (job := pipe.receive()) is not None:\n"
        "    os._exit(1) if len(job.chunk) == 13 else pipe.send(Ready())\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    return "echo_helper"


@pytest.mark.parametrize("sizes", [(), (3, 0, 5), (20_000, 7, 0, 50), (1_000_001,)])
def test_arrays_go_through_a_pipe_as_they_lie(sizes: tuple[int, ...]) -> None:
    """Small ones in the socket, large ones in memory that both ends see; the receiver owns them."""
    ours, theirs = (Pipe(fd) for fd in pair())
    sent = [np.arange(n, dtype=float) for n in sizes]
    for _ in range(2):
        ours.send(sent)
        found = theirs.receive()
        assert all(np.array_equal(a, b) for a, b in zip(sent, found, strict=True))
        for array in found:
            array[:] = 1.0  # the receiver's own
            assert array.ctypes.data % 8 == 0
    ours.close()
    with pytest.raises(EOFError):
        theirs.receive()
    theirs.close()


def until(true: Callable[[], bool], limit_s: float = 30.0) -> None:
    end_s = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_a_helper_that_dies_is_started_again(echo: str) -> None:
    answers: deque[Answer] = deque()
    helper = Helper(echo, [], answers.append)
    helper.put(Batch(np.zeros((5, 2)), None))
    until(lambda: len(answers) == 1)
    helper.put(Batch(np.zeros((13, 2)), None))
    until(lambda: helper.failures == 1)
    helper.put(Batch(np.zeros((1_000_000, 2)), None))
    until(lambda: len(answers) == 2)
    assert helper.stop()
    assert isinstance(answers[-1], Ready)


def test_a_helper_that_gets_little_of_a_busy_computer_ends_its_work(
    tmp_path: Path, echo: str
) -> None:
    """It has a tenth of a processor: its clock runs out long before its processor time."""
    module = tmp_path / "echo_helper.py"
    slow = "import time\nend = time.time() + 2.0\nwhile time.time() < end:\n    time.sleep(0.02)\n"
    module.write_text(module.read_text() + slow + "    for _ in range(50_000): pass\n")
    answers: deque[Answer] = deque()
    helper = Helper(echo, [], answers.append)
    helper.put(Batch(np.zeros((5, 2)), None))
    until(lambda: len(answers) == 1)
    assert helper.stop(patience_s=1.0)


def test_a_helper_goes_without_what_python_can_loads_of_itself(tmp_path: Path) -> None:
    """asammdf and pandas, where they are installed: 77 MB on the gateway."""
    (tmp_path / "shown.py").write_text("import sys, can\nprint(sys.argv, 'pandas' in sys.modules)")
    command = [sys.executable, "-m", "rtid.daemon.helped", "shown", "5"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [f"['{tmp_path / 'shown.py'}',", "'5']", "False"]


def test_a_helper_that_hangs_at_the_end_is_ended(echo: str) -> None:
    helper = Helper(echo, [], lambda _: None)
    until(lambda: helper.process is not None)
    assert helper.process is not None
    os.kill(helper.process.pid, 19)
    assert not helper.stop(patience_s=0.3)


def test_a_helper_that_is_slow_loses_the_oldest_batches_and_says_how_much(echo: str) -> None:
    helper = Helper(echo, [], lambda _: None)
    until(lambda: helper.process is not None)
    assert helper.process is not None
    os.kill(helper.process.pid, 19)
    one = frames(0.01)
    for _ in range(700):
        helper.put(Batch(np.zeros((1000, 9)), one))
    assert 0 < helper.dropped <= 7000 and helper.queued <= 500
    assert helper.queued * 72_000 <= 17 << 20  # and no more memory than that
    helper.stop(0.0)
