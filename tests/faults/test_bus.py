"""Faults of the bus and of the loop, on a daemon in this process with a scripted source."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections import deque
from dataclasses import replace
from pathlib import Path

import can
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources.can_bus import CanBus
from firmware_bridge.sources.live import LiveSource, SourceError
from rtid.daemon.daemon import Bus, Daemon, DaemonError
from rtid.daemon.status import Status
from rtid.project import Project, load
from tests.faults.conftest import Figure
from tests.faults.harness import at_s, drift, machine, without

pytestmark = pytest.mark.slow
CYCLES = 10  # per piece


class Scripted(LiveSource[Frames]):
    """The machine's frames; between two times every access fails, as after bus-off.

    hang_s: `read` stands still for 3 s, once, when so much time has passed; speed: times as fast.
    """

    def __init__(
        self, frames: Frames, down_s: tuple[float, float], hang_s: float = 1e9, speed: float = 1.0
    ) -> None:
        super().__init__(reopen_s=60.0)
        self._pieces = deque(frames.chunks(3 * CYCLES))
        self._first_us = int(frames.t_us[0])
        self._down_s, self._hang_s, self._speed = down_s, hang_s, speed
        self._start_s = time.monotonic()
        self.hung: tuple[float, float] | None = None

    def begun(self) -> Scripted:
        """It, once the daemon has compiled everything and opens its bus: time begins here."""
        self._start_s = time.monotonic()
        return self

    def now_s(self) -> float:
        return time.monotonic() - self._start_s

    def _is_down(self) -> bool:
        return self._down_s[0] <= self.now_s() < self._down_s[1]

    def _open(self) -> None:
        if self._is_down():
            raise SourceError("interface down")

    def _receive(self) -> Frames | None:
        if self._is_down():
            raise OSError("bus-off")
        while self._pieces and self._due_s() < self._down_s[1] <= self.now_s():
            self._pieces.popleft()  # nobody received it
        if not self._pieces or self._due_s() > self.now_s():
            time.sleep(0.005)
            return None
        return self._pieces.popleft()

    def _due_s(self) -> float:
        return float(self._pieces[0].t_us[-1] - self._first_us) * 1e-6 / self._speed

    def _convert(self, items: list[Frames]) -> Frames:
        return fr.concatenate(items)

    def _close(self) -> None:
        pass

    def read(self, timeout_s: float = 0.1) -> Frames:
        if self.hung is None and self.now_s() > self._hang_s:
            from_s = time.monotonic()
            time.sleep(3.0)
            self.hung = from_s, time.monotonic()
        return super().read(timeout_s)


def quick() -> Project:
    project = machine().project
    rates = {"rate_hz": 200.0, "publish_s": 2.0, "store_s": 2.0, "record_mb": 0}
    settings = project.sections.daemon.model_copy(update=rates)
    return replace(project, sections=replace(project.sections, daemon=settings))


def run(source: Scripted, folder: Path, for_s: float) -> tuple[Daemon, list[Status], Status]:
    """Run a daemon here; it, its statuses, and the last one."""
    daemon = Daemon(quick(), Bus("scripted", "x", source.begun), folder)
    seen: list[Status] = []

    def look() -> None:
        while watching:
            if daemon.status is not None and (not seen or seen[-1] is not daemon.status):
                seen.append(daemon.status)
            time.sleep(0.05)

    watching = [True]
    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        last = daemon.run(for_s)
    finally:
        watching.clear()
        thread.join()
    return daemon, seen, last


@pytest.mark.faults
def test_row_11_bus_off(tmp_path: Path, figure: Figure) -> None:
    frames, speed = machine().frames, 4.0
    source = Scripted(frames, (4.0, 9.0), speed=speed)
    _, seen, last = run(source, tmp_path, 16.0)
    back = next(
        s.now_unix_s - s.started_unix_s for s in seen
        if s.bus.reopened and (s.estimate.age_s or 9.0) < 1.0
    )  # fmt: skip
    opened = seen[0].started_unix_s - (time.time() - source.now_s())
    figure(11, "recovery after the bus is back, status told each second",
           back + opened - 9.0, 2.5, "s")  # fmt: skip
    assert any(s.bus.state == "reopening" for s in seen)
    assert {"bus_down"} <= {a.name for s in seen for a in s.alarms}
    assert last.bus.reopened == 1
    t_s = at_s(frames)
    gone = (t_s >= 4.0 * speed) & (t_s < 9.0 * speed)
    clean = machine().learned(without(frames, gone)).estimator.solution()
    from rtid.trace.snapshot import Generations

    found = Generations(tmp_path, quick().digest).restore(quick().model)
    assert found.estimator is not None
    figure(11, "drift against never having heard these 5 s",
           drift(clean, found.estimator.solution()), 0.001)  # fmt: skip


@pytest.mark.faults
def test_row_22_a_loop_that_hangs_feeds_no_watchdog(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figure: Figure
) -> None:
    """Only the loop hangs; the other threads are well."""
    beats: list[float] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "1000000")
        monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))

        def listen() -> None:
            while text := manager.recv(4096):
                if b"WATCHDOG=1" in text:
                    beats.append(time.monotonic())

        thread = threading.Thread(target=listen)
        thread.start()
        source = Scripted(machine().frames[:30_000], (1e9, 1e9), hang_s=3.0)
        try:
            _, seen, _ = run(source, tmp_path / "state", 9.0)
        finally:
            manager.shutdown(socket.SHUT_RD)  # wakes it with nothing; to close the socket does not
            thread.join()
    assert source.hung is not None
    begin_s, end_s = source.hung
    inside = [b for b in beats if begin_s + 0.1 < b < end_s]
    figure(22, "WATCHDOG while the loop alone hangs for 3 s", len(inside), 0)
    assert any(b < begin_s for b in beats) and any(b > end_s for b in beats)
    told = [s for s in seen if s.estimate.stale and (s.estimate.age_s or 0.0) > 1.0]
    assert told, "nobody was told that the outputs are old"


def test_only_one_daemon_per_folder(tmp_path: Path) -> None:
    source = Scripted(machine().frames[:3000], (1e9, 1e9))
    daemon = Daemon(quick(), Bus("scripted", "x", source.begun), tmp_path)
    thread = threading.Thread(target=daemon.run, args=(6.0,))
    thread.start()
    while daemon.status is None:
        time.sleep(0.05)
    other = Daemon(quick(), Bus("scripted", "x", source.begun), tmp_path)
    with pytest.raises(DaemonError, match="another daemon"):
        other.run(1.0)
    daemon.stop()
    thread.join()


def test_a_failure_leaves_the_last_frames_behind(tmp_path: Path) -> None:
    class Failing(Scripted):
        def _convert(self, items: list[Frames]) -> Frames:
            if self.now_s() > 3.0:
                raise ZeroDivisionError("a defect")
            return super()._convert(items)

    source = Failing(machine().frames[:30_000], (1e9, 1e9))
    with pytest.raises(ZeroDivisionError):
        run(source, tmp_path, 10.0)
    from firmware_bridge.sources import open_log

    (dump,) = tmp_path.glob("failure-*.log")
    assert 1900 <= len(open_log(dump)) <= 2300
    assert "a defect" in next(tmp_path.glob("failure-*.txt")).read_text()


def send_in_time(daemon: Daemon, channel: str, seconds: float) -> None:
    """The machine's frames with their own stamps, as they come, once the daemon hears them."""
    frames = machine().frames
    frames = frames[at_s(frames) < seconds]
    while daemon.status is None or daemon.status.bus.state != "open":
        time.sleep(0.01)
    start_s, t_s = time.monotonic(), at_s(frames)
    with can.Bus(interface="virtual", channel=channel, preserve_timestamps=True) as bus:
        for due_s, message in zip(t_s, fr.to_messages(frames), strict=True):
            if due_s > time.monotonic() - start_s:
                time.sleep(0.005)
            bus.send(message)


@pytest.mark.parametrize(
    ("every_s", "seconds"), [(0.1, 2.5), pytest.param(10.0, 20.5, marks=pytest.mark.soak)]
)
def test_upkeep_of_any_period_ends(every_s: float, seconds: float, tmp_path: Path) -> None:
    """In seconds of floating point it went round for ever at about every third upkeep."""
    written = tmp_path / "machine.toml"
    source = machine().trace.with_suffix(".toml").read_text("utf-8")
    settings = f"[upkeep]\nevery_s = {every_s}\n[daemon]\nrate_hz = 200.0\nrecord_mb = 0\n"
    written.write_text(f"{source}\n{settings}", "utf-8")
    channel = f"upkeep {every_s}"
    bus = Bus("virtual", channel, lambda: CanBus("virtual", channel))
    daemon = Daemon(load(written), bus, tmp_path / "state")
    thread = threading.Thread(target=send_in_time, args=(daemon, channel, seconds))
    thread.start()
    last = daemon.run(seconds + 1.0)
    thread.join()
    assert last.estimate.samples > 900 * seconds and not last.has("message_silent")
