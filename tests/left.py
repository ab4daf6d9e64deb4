"""What a test leaves behind: threads, processes, open files and sockets, entries of folders.

Linux tells all of it under /proc, without waiting; elsewhere only threads and folders count.
"""

from __future__ import annotations

import gc
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

OWN = Path("/proc/self")
LASTING = (
    b"multiprocessing.resource_tracker",
    b"multiprocessing.forkserver",
    b"chromium --type=",  # helpers of the browser of all tests come and go; the browser counts
)
THREADS = ("Dask-Offload",)  # of one pool that `distributed` keeps for the process
FOLDERS = (
    "dask-scratch-space",
    ".mypy_cache",
    ".ruff_cache",
    ".pytest_cache",
)  # of who runs beside
KEPT = ("anon_inode:", "/dev/", "/proc/", "/sys/")  # of libraries, and of the system
TEMPORARY = tempfile.gettempdir()
LIBRARIES = "/site-packages/"  # fonts that matplotlib keeps open
OF_RUN = "RTID_TESTS_FOLDER"  # environment: the folder of this run
PATIENCE_S = 3.0  # for what is just about to end


@cache
def _for_all() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="rtid-tests-", dir=TEMPORARY)


def shared_folder(name: str) -> Path:
    """A folder for what all tests of a run share; it goes when the run ends."""
    return Path(tempfile.mkdtemp(prefix=name, dir=_for_all().name))


def of_this_run(config: pytest.Config) -> None:
    """Make the folder that both workers share, in their environment; it goes when the run ends."""
    if not hasattr(config, "workerinput"):
        os.environ[OF_RUN] = folder = tempfile.mkdtemp(prefix="rtid-tests-", dir=TEMPORARY)
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))


def children(pid: int) -> Iterator[int]:
    """Processes that this one has started and that run, and theirs."""
    for told in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found = [int(word) for word in told.read_text("ascii").split()]
        except OSError:  # the thread has ended meanwhile
            continue
        for child in found:
            yield child
            yield from children(child)


def command(pid: int) -> bytes:
    """The command line of a process; empty where it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ")
    except OSError:
        return b""


def _processes() -> set[str]:
    told = ((pid, command(pid)) for pid in children(os.getpid()))
    return {
        f"process {pid} {text.decode(errors='replace')}"
        for pid, text in told
        if not any(word in text for word in LASTING)
    }


def _handles() -> set[str]:
    found = set()
    for entry in (OWN / "fd").iterdir() if OWN.exists() else ():
        try:
            target = os.readlink(entry)
        except OSError:  # the one of this listing
            continue
        if not target.startswith(KEPT) and LIBRARIES not in target:
            found.add(f"open {target}")
    return found


def _entries(folder: Path) -> set[str]:
    return {f"file {folder / name}" for name in os.listdir(folder) if name not in FOLDERS}


@dataclass(frozen=True)
class Here:
    """What there is at one moment."""

    threads: frozenset[threading.Thread]
    rest: frozenset[str]

    @classmethod
    def now(cls, *folders: Path) -> Here:
        """Threads of this process, its children, its open files, and what is in these folders."""
        rest = _processes() | _handles()
        for folder in folders:
            rest |= _entries(folder)
        return cls(frozenset(threading.enumerate()), frozenset(rest))

    def left(self, now: Here) -> list[str]:
        """What has come since."""
        new = (t for t in now.threads - self.threads if not t.name.startswith(THREADS))
        threads = [f"thread {t.name}" for t in new if t.is_alive()]
        return sorted([*threads, *(now.rest - self.rest)])


def left_since(before: Here, *folders: Path) -> list[str]:
    """What is left behind, once what was about to end has had its time."""
    end_s = time.monotonic() + PATIENCE_S
    while left := before.left(Here.now(*folders)):
        if time.monotonic() > end_s:
            break
        gc.collect()  # takes a tenth of a second: not for each test
        time.sleep(0.05)
    return left
