"""`rtid run` in a process of its own, with somebody on its bus and a listening service manager."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from firmware_bridge.frames import Frames
from rtid.daemon.status import Status, StatusError, from_json, read
from rtid.estimator.estimator import Estimator
from rtid.project import Project
from rtid.trace.learner import Learner
from rtid.trace.snapshot import Generations
from tests.faults.harness import SECONDS, machine

LIMIT_S = 60.0  # of its own processor time that a daemon may take for what it is waited for
HANGS_S = 600.0  # where it takes none: other work may keep it from the processor for long
ROOT = Path(__file__).parents[2]


@dataclass
class Daemon:
    """A running daemon: its process, state folder, multicast group, and what it told systemd."""

    process: subprocess.Popen[str]
    folder: Path
    group: str
    started_s: float
    told: list[tuple[float, str]] = field(default_factory=list)  # seconds since the start, message

    def status(self) -> Status | None:
        """The newest one; None before the first."""
        with contextlib.suppress(StatusError):
            return read(self.folder)
        return None

    def is_its_own(self, status: Status) -> bool:
        """Whether this process told it, not one before it."""
        return status.pid == self.process.pid

    def wait(self, what: Callable[[Status], bool], limit_s: float = LIMIT_S) -> float:
        """Seconds until the status says so; fails as `patiently` does."""
        for since_s in self.patiently(limit_s):
            found = self.status()
            if found is not None and what(found):
                return since_s
        raise AssertionError("unreachable")

    def patiently(self, limit_s: float = LIMIT_S) -> Iterator[float]:
        """Seconds since the start, 50 times per second, for as long as the daemon may take.

        It fails when the daemon has ended, has used limit_s of processor time (so that the load of
        the machine does not count), or hangs: has used none for HANGS_S.
        """
        start_s, used_s = time.monotonic(), self.cpu_s()
        newest_s, moved_s = used_s, start_s
        while newest_s - used_s < limit_s and time.monotonic() - moved_s < HANGS_S:
            yield time.monotonic() - start_s
            assert self.process.poll() is None, self.process.communicate()[1]
            time.sleep(0.02)
            if (now_s := self.cpu_s()) != newest_s:
                newest_s, moved_s = now_s, time.monotonic()
        raise AssertionError(f"not within {limit_s} s of processor time: {_short(self.status())}")

    def stop(self, limit_s: float = LIMIT_S) -> Status:
        """SIGTERM, and its last status."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        out, err = self.process.communicate(timeout=limit_s)
        assert self.process.returncode == 0, err
        return from_json(out)

    def cpu_s(self) -> float:
        """Processor time of the daemon's own process so far, s."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text("ascii").rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def handles(self) -> int:
        """Files, sockets and pipes that it holds."""
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def analyst(self) -> int:
        """Process id of its helper."""
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                parent = int(stat.read_text("ascii").rsplit(")", 1)[1].split()[1])
                command = stat.with_name("cmdline").read_bytes()
                if parent == self.process.pid and b"rtid.daemon.analyst" in command:
                    return int(stat.parent.name)
        raise AssertionError("the daemon has no analyst")


def _short(status: Status | None) -> str:
    """A status without its histograms and signals."""
    if status is None:
        return "no status"
    return f"{status.bus}, {status.estimate}, {status.store}, {[a.text for a in status.alarms]}"


def a_group() -> str:
    """A multicast group that nobody else uses."""
    return "239.74." + ".".join(str(Random(os.urandom(8)).randint(1, 254)) for _ in range(2))


@contextlib.contextmanager
def daemon(
    folder: Path,
    *options: str,
    settings: str = "",
    group: str = "",
    edit: Callable[[str], str] = str,
) -> Iterator[Daemon]:
    """`rtid run` on a multicast group of its own; killed at the end where it still runs."""
    (folder / "notify").unlink(missing_ok=True)
    project = folder / "machine.toml"
    source = machine().trace.with_suffix(".toml").read_text("utf-8")
    project.write_text(f"{edit(source)}\n[daemon]\n{settings}\n", "utf-8")
    group = group or a_group()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(folder / "notify"))
        environment = os.environ | {
            "NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "1000000",
            "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
        }  # fmt: skip
        state = folder / "state"
        command = [
            sys.executable, "-m", "rtid", "run", str(project), "--bus", f"udp_multicast:{group}",
            "--test-bus", "--json", "--state", str(state), *options,
        ]  # fmt: skip
        process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        started = Daemon(process, state, group, time.monotonic())
        listener = threading.Thread(target=_listen, args=(manager, started))
        listener.start()
        try:
            yield started
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGCONT)
            ended(process)
            manager.shutdown(socket.SHUT_RD)  # wakes the listener with nothing
            listener.join()


@contextlib.contextmanager
def apart_from_others() -> Iterator[bool]:
    """What is started meanwhile takes turns among itself, before all other work of the machine.

    Whether that was granted: else what is measured is that work's as well.
    """
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except OSError:
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, *before)


@contextlib.contextmanager
def replayed(folder: Path, settings: str, loops: int) -> Iterator[Daemon]:
    """A daemon that hears the machine's minute `loops` times at ten times its pace."""
    project, state = folder / "machine.toml", folder / "state"
    source = machine().trace.with_suffix(".toml").read_text("utf-8")
    project.write_text(f"{source}\n[daemon]\n{settings}\n", "utf-8")
    command = [
        sys.executable, "-m", "tests.faults.replayed", str(project), str(machine().trace),
        str(state), str(SECONDS), "10", str(loops),
    ]  # fmt: skip
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        yield Daemon(process, state, "", time.monotonic())
    finally:
        ended(process)


def _listen(manager: socket.socket, started: Daemon) -> None:
    while text := manager.recv(4096).decode():
        started.told.append((time.monotonic() - started.started_s, text))


@contextlib.contextmanager
def sender(
    group: str,
    seconds: float,
    speed: float = 1.0,
    loops: int = 1,
    flood_hz: float = 0.0,
    trace: Path | None = None,
    is_prompt: bool = False,
) -> Iterator[subprocess.Popen[str]]:
    """Somebody who sends the machine's frames; ended at the end.

    is_prompt: as a bus does, which the computer's other work does not keep waiting.
    """
    command = [
        sys.executable, "-m", "tests.faults.sender", str(trace or machine().trace), group,
        str(seconds), str(speed), str(loops), str(flood_hz),
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    if is_prompt:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(process.pid, os.SCHED_RR, os.sched_param(1))
    try:
        yield process
    finally:
        ended(process)


@contextlib.contextmanager
def idle(rate_hz: float, priority: int) -> Iterator[subprocess.Popen[str]]:
    """A loop of that rate and priority which does nothing; SIGTERM makes it tell what it missed."""
    command = [sys.executable, "-m", "tests.faults.idle", str(rate_hz), str(priority)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        yield process
    finally:
        ended(process)


def ended(process: subprocess.Popen[str]) -> None:
    """Kill it where it still runs, and close its pipes."""
    process.kill()
    with process:
        pass


def stored(folder: Path, project: Project) -> Learner:
    """A learner with what the daemon left behind."""
    learner = machine().learner()
    found = Generations(folder, project.digest).restore(project.model)
    assert found.estimator is not None, found
    learner.estimator = found.estimator
    return learner


def recorded(folder: Path) -> int:
    """Frames in the recording of a state folder."""
    return sum(len(frames) for frames in _recording(folder))


def heard(folder: Path) -> Estimator:
    """What is learned, without any break, of all that the daemons of a folder have heard."""
    learner = machine().learner()
    for frames in _recording(folder):
        for part in frames.chunks(3000):
            learner.push(part)
    return learner.estimator


def _recording(folder: Path) -> Iterator[Frames]:
    from firmware_bridge.sources import open_log

    return map(open_log, sorted((folder / "recording").glob("*.blf")))
