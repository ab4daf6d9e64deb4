"""Faults of a running daemon: stalls, kills, overload, hangs, a disk that is full."""

from __future__ import annotations

import os
import resource
import signal
import sqlite3
import time
from pathlib import Path

import pytest

from tests.faults.conftest import Figure
from tests.faults.harness import machine
from tests.faults.process import a_group, daemon, recorded, sender, stored

pytestmark = pytest.mark.slow

QUICK = "publish_s = 2\nstore_s = 2\n"


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


def test_row_9_and_10_stalled_for_two_seconds(tmp_path: Path, figure: Figure) -> None:
    """The whole process stands still for 2 s at 3,000 frames/s: nothing is lost but time."""
    with daemon(tmp_path, settings=QUICK) as running:
        running.wait(lambda s: s.pid > 0)
        with sender(running.group, 12.0) as sending:
            running.wait(lambda s: s.estimate.samples > 3000)
            before = running.status()
            running.process.send_signal(signal.SIGSTOP)
            time.sleep(2.0)
            running.process.send_signal(signal.SIGCONT)
            resumed_s = time.monotonic()
            assert before is not None
            caught_up = running.wait(
                lambda s: s.now_unix_s > before.now_unix_s + 2.0 and not s.estimate.stale
            )
            sent = int(sending.communicate()[0])
        running.wait(lambda s: s.bus.frames >= sent, 10.0)
        last = running.stop()
    assert caught_up < time.monotonic() - resumed_s
    figure(9, "frames lost in a stall of 2 s", sent - last.bus.frames, 0)
    figure(10, "backlog of 2 s drained, status told, after", caught_up, 2.0, "s")
    alone = machine().learned(machine().frames[:36_000])
    learned = stored(running.folder, machine().project)
    same = learned.estimator.state.memory.tobytes() == alone.estimator.state.memory.tobytes()
    figure(10, "estimate differs from that without a stall", 0 if same else 1, 0)


def test_row_10_stale_while_old(tmp_path: Path, figure: Figure) -> None:
    """When the sender is silent, what is published says that it is old."""
    with daemon(tmp_path, settings=QUICK) as running:
        running.wait(lambda s: s.pid > 0)
        with sender(running.group, 3.0) as sending:
            running.wait(lambda s: s.estimate.samples > 1000 and not s.estimate.stale)
            sending.communicate()
        figure(10, "stale after the last frame",
               running.wait(lambda s: s.estimate.stale), 2.5, "s")  # fmt: skip
        last = running.stop()
    assert last.estimate.age_s is not None and last.estimate.age_s > 0.05
    assert {m.verdict for m in last.messages} == {"silent"}


def test_row_17_kill_9_while_it_runs(tmp_path: Path, figure: Figure) -> None:
    """Killed twice, started again: it goes on from the newest snapshot (50 times: `make soak`)."""
    group, lost = a_group(), []
    with sender(group, 60.0, loops=3):
        for k in range(3):
            with daemon(tmp_path, settings=QUICK, group=group) as running:
                running.wait(running.is_its_own)
                running.wait(lambda s: s.store.state == "saved" and s.estimate.version > 0)
                found = running.status()
                assert found is not None
                assert k == 0 or found.store.restored in ("state-0.npz", "state-1.npz")
                lost.append(found.store.age_s or 0.0)
                if k < 2:
                    running.process.kill()
                else:
                    running.stop()
    figure(17, "age of the snapshot at a kill (saved every 2 s)", max(lost), 3.0, "s")
    taken = stored(running.folder, machine().project).estimator.counters["samples"]
    figure(17, "samples that all three runs together have learned from", taken, least=5000)


def test_row_18_disk_full(tmp_path: Path, figure: Figure) -> None:
    """The helper may write no more than 1 KB: NOT SAVED, an alarm, and well again by itself."""
    with daemon(tmp_path, settings=QUICK) as running:
        running.wait(lambda s: s.pid > 0)
        with sender(running.group, 30.0):
            running.wait(lambda s: s.store.state == "saved")
            helper = running.analyst()
            before = resource.prlimit(helper, resource.RLIMIT_FSIZE)
            resource.prlimit(helper, resource.RLIMIT_FSIZE, (1000, before[1]))
            alarm_s = running.wait(lambda s: s.store.state == "NOT SAVED")
            full = running.status()
            resource.prlimit(helper, resource.RLIMIT_FSIZE, before)
            well_s = running.wait(lambda s: s.store.state == "saved")
            last = running.stop()
    assert full is not None and "not_saved" in {a.name for a in full.alarms}
    figure(18, "alarm after the disk is full (save interval 2 s)", alarm_s, 2.0, "s")
    figure(18, "saved again after there is room", well_s, 8.0, "s")
    assert last.bus.refused.get("overrun", 0) == 0


def test_row_18_slow_disk_does_not_reach_the_loop(tmp_path: Path, figure: Figure) -> None:
    """The helper stands still for 5 s: frames are taken, the loop ticks, learning goes on."""
    with daemon(tmp_path, settings=QUICK) as running:
        running.wait(lambda s: s.pid > 0)
        with sender(running.group, 20.0) as sending:
            running.wait(lambda s: s.store.state == "saved")
            helper, before = running.analyst(), running.status()
            os.kill(helper, signal.SIGSTOP)
            time.sleep(5.0)
            during = running.status()
            os.kill(helper, signal.SIGCONT)
            sent = int(sending.communicate()[0])
        running.wait(lambda s: s.bus.frames >= sent, 10.0)
        running.stop()
    assert before is not None and during is not None
    learned = during.estimate.samples - before.estimate.samples
    figure(18, "samples learned while the disk hangs for 5 s", learned, least=3500)


def test_row_22_hang(tmp_path: Path, figure: Figure) -> None:
    """No WATCHDOG while the process stands still, and again when it goes on."""
    with daemon(tmp_path, settings=QUICK) as running:
        running.wait(lambda s: s.pid > 0)
        with sender(running.group, 15.0):
            running.wait(lambda s: s.estimate.samples > 2000)
            running.process.send_signal(signal.SIGSTOP)
            from_s = time.monotonic() - running.started_s
            time.sleep(3.0)
            running.process.send_signal(signal.SIGCONT)
            to_s = time.monotonic() - running.started_s
            time.sleep(1.5)
            running.stop()
    beats = [at_s for at_s, text in running.told if "WATCHDOG=1" in text]
    figure(22, "WATCHDOG while hung", sum(from_s + 0.2 < b < to_s for b in beats), 0)
    figure(22, "WATCHDOG per second otherwise",
           sum(b > to_s for b in beats) / (max(beats) - to_s), least=2.0)  # fmt: skip
