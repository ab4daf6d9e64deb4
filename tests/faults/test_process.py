"""Faults of a running daemon: stalls, kills, overload, hangs, a disk that is full."""

from __future__ import annotations

import os
import resource
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from rtid.cli.exits import Exit
from rtid.daemon.status import Status, from_json
from rtid.sim.bus import run_frames
from rtid.sim.hidden import hide_wish
from rtid.sim.run import PlantChange, simulate
from rtid.sim.run_files import START_US, write_log
from rtid.sim.simulated_plant import SimulatedPlant
from tests.daemon.disk import fill, mounted
from tests.faults.conftest import Figure
from tests.faults.harness import FRAMES_PER_CYCLE, SECONDS, drift, machine
from tests.faults.process import Daemon, a_group, daemon, heard, recorded, sender, stored

real_time = pytest.mark.faults

QUICK = "publish_s = 2\nstore_s = 2\n"
STATES = ("state-0.npz", "state-1.npz", "shadow.npz")  # gone on with after a kill
SPEED = 3.0
MOST_BYTES = 1_400_000  # more than a map that is handed over, less than a snapshot
DAY_S = 22.0


@pytest.mark.slow
def test_a_run_from_start_to_end(tmp_path: Path, figure: Figure) -> None:
    """READY with the first sample, all frames taken and recorded, the state as from the log."""
    with daemon(tmp_path, settings=QUICK) as running:
        running.wait(lambda s: s.pid > 0)
        listens_s, used_s = time.monotonic() - running.started_s, running.cpu_s()
        with sender(running.group, 10.0) as sending:
            running.wait(lambda s: s.estimate.samples > 0)
            sent = int(sending.communicate()[0])
        running.wait(lambda s: s.bus.frames == sent and s.estimate.version > 0)
        last = running.stop()
    ready = [at_s for at_s, text in running.told if "READY=1" in text]
    assert len(ready) == 1 and any("STOPPING=1" in text for _, text in running.told)
    assert last.estimate.samples == 10_000
    assert ready[0] >= 0.5 * listens_s  # not before samples were accepted
    figure(22, "listening after the start, cache warm, this machine's load", listens_s, unit="s")
    figure(22, "processor time until it listens, cache warm", used_s, 3.0, "s")
    figure(14, "frames lost of a run without faults", sent - last.bus.frames, 0)
    figure(14, "frames not recorded", sent - recorded(running.folder), 0)
    alone = machine().learned(machine().frames[:30_000])
    learned = stored(running.folder, machine().project)
    assert learned.estimator.state.memory.tobytes() == alone.estimator.state.memory.tobytes(), (
        "live is not replay"
    )
    with sqlite3.connect(running.folder / "history.sqlite") as history:
        assert history.execute("SELECT count(*) FROM estimate").fetchone()[0] >= 2
        assert history.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    assert (running.folder / "map.npz").exists()


@dataclass(frozen=True)
class Day:
    """What a daemon went through, hour by hour; times in seconds."""

    caught_up_s: float  # after a stall of 2 s
    full_s: float  # from a full disk to NOT SAVED
    full: Status
    well_s: float  # from room on the disk to a snapshot
    learned: int  # samples while the helper stood still for 5 s
    stale_s: float  # after the last frame
    beats: int  # WATCHDOG while the process stood still for 3 s
    beats_hz: float  # after that
    sent: int
    last: Status
    folder: Path


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Day:
    """One daemon through stall, full disk, slow disk, silence and hang: a start costs seconds."""
    with daemon(tmp_path_factory.mktemp("day"), settings=QUICK) as running:
        running.wait(lambda s: s.pid > 0)
        with sender(running.group, DAY_S) as sending:
            running.wait(lambda s: s.estimate.samples > 6000)
            caught_up_s = stalled(running)
            helper = running.analyst()
            full_s, full, well_s = filled(running, helper)
            learned = slowed(running, helper)
            sent = int(sending.communicate()[0])
        end_s = time.time()
        stale_s = running.wait(lambda s: s.estimate.stale and s.now_unix_s > end_s)
        running.wait(lambda s: s.bus.frames >= sent, 10.0)
        from_s, to_s = hung(running)
        last = running.stop()
    beats = [at_s for at_s, text in running.told if "WATCHDOG=1" in text]
    after = [at_s for at_s in beats if at_s > to_s]
    return Day(
        caught_up_s, full_s, full, well_s, learned, stale_s,
        sum(from_s < at_s < to_s for at_s in beats), len(after) / (max(beats) - to_s),
        sent, last, running.folder,
    )  # fmt: skip


def stalled(running: Daemon) -> float:
    """The whole process stands still for 2 s; seconds until its outputs are fresh again."""
    before = running.status()
    assert before is not None
    running.process.send_signal(signal.SIGSTOP)
    time.sleep(2.0)
    running.process.send_signal(signal.SIGCONT)
    return running.wait(lambda s: s.now_unix_s > before.now_unix_s + 2.0 and not s.estimate.stale)


def filled(running: Daemon, helper: int) -> tuple[float, Status, float]:
    """The helper may write no snapshot: NOT SAVED, an alarm, and well again by itself.

    The limit holds for files in memory too, through which the helper hands over its maps.
    """
    running.wait(lambda s: s.store.state == "saved")
    before = resource.prlimit(helper, resource.RLIMIT_FSIZE)
    resource.prlimit(helper, resource.RLIMIT_FSIZE, (MOST_BYTES, before[1]))
    alarm_s = running.wait(lambda s: s.store.state == "NOT SAVED")
    full = running.status()
    assert full is not None
    resource.prlimit(helper, resource.RLIMIT_FSIZE, before)
    return alarm_s, full, running.wait(lambda s: s.store.state == "saved")


def slowed(running: Daemon, helper: int) -> int:
    """The helper stands still for 5 s; samples that the daemon has learned meanwhile."""
    before = running.status()
    os.kill(helper, signal.SIGSTOP)
    time.sleep(5.0)
    during = running.status()
    os.kill(helper, signal.SIGCONT)
    assert before is not None and during is not None
    return during.estimate.samples - before.estimate.samples


def hung(running: Daemon) -> tuple[float, float]:
    """The process stands still for 3 s: from when to when, s since its start.

    The span begins when it has stopped and what it told before is read, and ends before it is told
    to go on: this process may be kept from the processor at any of these points.
    """
    running.process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, running.process.pid, os.WSTOPPED | os.WNOWAIT)
    time.sleep(0.2)
    from_s = time.monotonic() - running.started_s
    time.sleep(2.8)
    to_s = time.monotonic() - running.started_s
    running.process.send_signal(signal.SIGCONT)
    time.sleep(1.5)
    return from_s, to_s


def learns(running: Daemon, more: int) -> None:
    """Wait until so many more samples are learned."""
    found = running.status()
    assert found is not None
    enough = found.estimate.samples + more
    running.wait(lambda s: s.estimate.samples > enough)


@real_time
def test_row_9_and_10_stalled_for_two_seconds(day: Day, figure: Figure) -> None:
    """Through all of that day nothing is lost but time."""
    figure(9, "frames lost in a stall of 2 s", day.sent - day.last.bus.frames, 0)
    figure(10, "backlog of 2 s drained, status told, after", day.caught_up_s, 2.0, "s")
    alone = machine().learned(machine().frames[: round(DAY_S) * 1000 * FRAMES_PER_CYCLE])
    learned = stored(day.folder, machine().project)
    same = learned.estimator.state.memory.tobytes() == alone.estimator.state.memory.tobytes()
    figure(10, "estimate differs from that without a stall", 0 if same else 1, 0)


@real_time
def test_row_10_stale_while_old(day: Day, figure: Figure) -> None:
    """When the sender is silent, what is published says that it is old, and an alarm who is."""
    figure(10, "stale after the last frame", day.stale_s, 2.5, "s")
    assert day.last.estimate.age_s is not None and day.last.estimate.age_s > 0.05
    assert {m.verdict for m in day.last.messages} == {"silent"}
    silent = next(a for a in day.last.alarms if a.name == "message_silent")
    assert all(m.name in silent.text for m in day.last.messages)


@real_time
def test_row_18_disk_full(day: Day, figure: Figure) -> None:
    assert day.full.has("not_saved")
    figure(18, "alarm after the disk is full (save interval 2 s)", day.full_s, 2.0, "s")
    figure(18, "saved again after there is room", day.well_s, 8.0, "s")
    assert day.last.bus.refused.get("overrun", 0) == 0


@real_time
def test_row_18_slow_disk_does_not_reach_the_loop(day: Day, figure: Figure) -> None:
    """Frames are taken, the loop ticks, learning goes on."""
    figure(18, "samples learned while the disk hangs for 5 s", day.learned, least=3500)


@real_time
def test_row_22_hang(day: Day, figure: Figure) -> None:
    """No WATCHDOG while the process stands still, and again when it goes on."""
    figure(22, "WATCHDOG while hung", day.beats, 0)
    figure(22, "WATCHDOG per second otherwise", day.beats_hz, least=2.0)


@real_time
def test_row_17_kill_9_while_it_runs(tmp_path: Path, figure: Figure) -> None:
    """Killed twice while the machine moves: it goes on from the newest snapshot (50 times: soak).

    The motion comes SPEED times as fast, so that a save interval and a start lose as much more; it
    goes on until the last daemon has learned half a minute of it.
    """
    group, lost = a_group(), []
    with sender(group, SECONDS, speed=SPEED, loops=20) as sending:
        for k in range(3):
            with daemon(tmp_path, settings=QUICK, group=group) as running:
                running.wait(running.is_its_own)
                running.wait(lambda s: s.store.state == "saved" and s.estimate.version > 0)
                found = running.status()
                assert found is not None
                assert k == 0 or found.store.restored in STATES
                lost.append(found.store.age_s or 0.0)
                if k < 2:
                    running.process.kill()
                else:
                    learns(running, 30_000)
                    sending.kill()
                    running.stop()
    figure(17, "age of the snapshot at a kill (saved every 2 s)", max(lost), 3.0, "s")
    learned = stored(running.folder, machine().project).estimator
    figure(17, "drift after 2 kills against no kill, of what was heard",
           drift(heard(running.folder).solution(), learned.solution()), 0.01)  # fmt: skip


@pytest.mark.faults
def test_row_33_a_disk_that_is_really_full(tmp_path: Path, figure: Figure) -> None:
    """The status, on that very disk, says so at once; the end says it by its exit code."""
    settings = "publish_s = 60\nstore_s = 30\n"  # the next save is half a minute away
    with (
        mounted(tmp_path / "state", 128 << 20) as disk,
        daemon(tmp_path, settings=settings) as running,
    ):
        running.wait(lambda s: s.pid > 0)
        with sender(running.group, 60.0):
            running.wait(lambda s: s.estimate.samples > 1000 and s.store.state == "saved")
            fill(disk)
            full_s = running.wait(lambda s: s.store.state == "NOT SAVED" and s.has("not_saved"))
            segments = len(list((disk / "recording").glob("*.blf")))
            time.sleep(3.0)
            more = len(list((disk / "recording").glob("*.blf"))) - segments
            running.process.send_signal(signal.SIGTERM)
            out, _ = running.process.communicate(timeout=60.0)
    figure(33, "NOT SAVED after the disk is really full (saved every 30 s)", full_s, 2.0, "s")
    figure(33, "files that the recorder makes on a full disk in 3 s", more, 0)
    assert running.process.returncode == Exit.NEGATIVE
    last = from_json(out)
    assert last.store.state == "NOT SAVED" and "last state" in last.store.reason


@pytest.mark.soak
def test_a_changed_machine_is_accepted(tmp_path: Path) -> None:
    """A leak begins; learning stops, until the engineer says that this is how it is to be."""
    worn, trace = (
        hide_wish(SimulatedPlant(), "internal_leakage_laminar=strong"),
        tmp_path / "worn.blf",
    )
    run = simulate(SimulatedPlant(), "rich", 1, SECONDS, change=PlantChange(40.0, worn))
    write_log(trace, run_frames(run, start_us=START_US))
    accept = [sys.executable, "-m", "rtid", "accept", str(tmp_path / "state"), "--reason", "test"]
    with daemon(tmp_path, settings=QUICK) as running:
        running.wait(lambda s: s.pid > 0)
        with sender(running.group, SECONDS, speed=SPEED, trace=trace):
            # the alarm is told at once, the rest of the status within a second
            running.wait(lambda s: s.has("plant_changed") and s.estimate.state == "suspended")
            said = subprocess.run(accept, capture_output=True, text=True, check=False)
            running.wait(lambda s: s.estimate.state == "learning")
            again = subprocess.run(accept, capture_output=True, text=True, check=False)
        running.stop()
    assert said.returncode == 0 and "accepted" in said.stdout, said.stderr
    assert again.returncode == 4 and "nothing to accept" in again.stdout
    assert list(running.folder.glob("*/points/*-accept.npz"))
    with sqlite3.connect(running.folder / "history.sqlite") as history:
        assert history.execute("SELECT reason FROM decision").fetchall() == [("test",)]
    taken = stored(running.folder, machine().project).estimator.counters["samples"]
    assert 0 < taken < 25_000, "the healthy 40 s are still in it"
