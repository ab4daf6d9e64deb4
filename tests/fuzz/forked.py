"""One case in a fork of this warm process, under limits of processor time, clock and memory."""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import shutil
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

MOST_CPU_S = 20.0  # on a machine on which sound cases are no slower
MOST_WALL_S = 120.0  # beside others on a busy machine; a command that sleeps is found by it
MOST_MB = 1000.0
MORE_ADDRESS_SPACE = 2 << 30  # beyond what this process has: the machine must survive a bomb


@dataclass(frozen=True)
class Verdict:
    """What is wrong with a case ("" if nothing), with the detail, its exit code and its cost."""

    name: str
    arguments: tuple[str, ...]
    defect: str
    detail: str
    code: int
    cpu_s: float
    peak_mb: float


@dataclass
class Running:
    """A case on its way in a child of its own process group."""

    name: str
    folder: Path
    slower: float = 1.0  # than what the limits of time are for
    pid: int = 0
    began: float = field(default_factory=time.monotonic)

    def start(self, work: Callable[[Path], dict[str, object]]) -> Running:
        """Fork; the child writes what `work` gives to a file and ends."""
        self.folder.mkdir(parents=True)
        self.pid = os.fork()
        if self.pid == 0:
            try:
                _limit(self.folder, round(self.slower * MOST_CPU_S))
                (self.folder / "told.json").write_text(json.dumps(work(self.folder)))
            except BaseException:  # of the fuzz itself: to be seen, and the child must end here
                (self.folder / "stack.txt").write_text(traceback.format_exc())
            finally:
                os._exit(0)
        return self

    def poll(self) -> Verdict | None:
        """The verdict when it has ended; a child that takes too long is ended."""
        pid, status, used = os.wait4(self.pid, os.WNOHANG)
        if pid == 0:
            if time.monotonic() - self.began > self.slower * MOST_WALL_S:
                os.kill(self.pid, signal.SIGXCPU)
                time.sleep(0.5)
                os.killpg(self.pid, signal.SIGKILL)
            return None
        return self._judge(status, used)

    def _judge(self, status: int, used: resource.struct_rusage) -> Verdict:
        cpu_s, peak_mb = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
        told = self.folder / "told.json"
        facts = json.loads(told.read_text()) if told.exists() else {}
        defect, detail = facts.get("defect", ""), facts.get("detail", "")
        if os.WIFSIGNALED(status):
            ended = signal.Signals(os.WTERMSIG(status))
            hung = ended in (signal.SIGXCPU, signal.SIGKILL)
            defect, detail = ("hang" if hung else "crash"), f"{ended.name}\n{self._stack()}"
        elif not facts:
            defect, detail = "crash", f"ended without a word\n{self._stack()}"
        if "MemoryError" in detail or "ArrowMemoryError" in detail or peak_mb > MOST_MB:
            defect, detail = "memory", f"{peak_mb:.0f} MB\n{detail}"
        arguments = tuple(facts.get("arguments", ()))
        return Verdict(self.name, arguments, defect, detail, facts.get("code", -1), cpu_s, peak_mb)

    def _stack(self) -> str:
        stack = self.folder / "stack.txt"
        return stack.read_text() if stack.exists() else ""

    def keep(self, verdict: Verdict, out: Path) -> None:
        """Copy the input that failed, with the verdict, to out/NAME."""
        kept = out / self.name
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(self.folder, kept, symlinks=False)
        (kept / "verdict.json").write_text(json.dumps(asdict(verdict), indent=1))


def _limit(folder: Path, cpu_s: int) -> None:
    os.setsid()
    stack = (folder / "stack.txt").open("w")  # open as long as the child lives
    faulthandler.register(signal.SIGXCPU, stack, all_threads=True, chain=True)
    faulthandler.enable(stack)
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MORE_ADDRESS_SPACE
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
