"""The desk in a process of its own: jobs in, progress and results out, one after the other."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Event
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from firmware_bridge.kept_out import keep_out_asammdf
from rtid.errors import RtidError
from rtid.plain import Progress, give_back
from rtid.ui.parcel import packed

if TYPE_CHECKING:
    from rtid.ui.reader import Reader

Then = Callable[[Any], None]
OnLoop = Callable[[Callable[[], None]], None]
OUR_PACKAGES = ("rtid", "firmware_bridge")  # their errors are meant for the user
POLITE = 5
ENDED = "the worker has ended", "start `rtid ui` again"


class WorkerError(RtidError):
    """A job failed for a reason that is not the user's, or its process has ended."""

    exit_code = 1


class StoppedError(Exception):
    """Nobody waits for a job any more."""


@dataclass(frozen=True)
class Job:
    """A method of the desk, its arguments, and who waits for progress, result or refusal."""

    method: str
    arguments: tuple[Any, ...]
    then: Then
    failed: Callable[[RtidError], None]
    progress: Progress


def serve(pipe: Connection, folder: Path, stop: Event) -> None:
    """Work until the pipe is closed.  Runs in the worker's process.

    folder: for what is large in an answer; stop: is set when nobody waits for the job any more.
    """
    os.nice(POLITE)  # the page comes first
    keep_out_asammdf()
    from rtid.ui.reader import Reader  # noqa: PLC0415 - only the worker imports what reads

    def progress(text: str, share: float) -> None:
        if stop.is_set():
            raise StoppedError("stopped")
        pipe.send(("progress", (text, share)))

    desk = Reader(progress)
    while True:
        try:
            method, arguments = pipe.recv()
        except (EOFError, OSError, KeyboardInterrupt):
            return
        stop.clear()
        try:
            desk = desk if hasattr(desk, method) else _whole(desk)
            pipe.send(("done", packed(getattr(desk, method)(*arguments), folder)))
        except KeyboardInterrupt:
            return
        except Exception as error:
            pipe.send(("refused", in_words(method, error)))
        give_back()


def _whole(reader: Reader) -> Reader:
    """The desk of what was read: whoever waits for a record's signals need not wait for it."""
    from rtid.ui.desk import Desk  # noqa: PLC0415 - the estimator's weight, a second or two

    return Desk.behind(reader)


@contextmanager
def started(*, ahead: bool) -> Iterator[Worker]:
    """A worker, its process begun at once with `ahead`, and ended in the end."""
    worker = Worker()
    if ahead:
        worker.warm()
    try:
        yield worker
    finally:
        worker.stop()


def ignore(*_: object) -> None:
    """What came of a job that nobody waits for."""


def in_words(method: str, error: Exception) -> tuple[str, str]:
    """An error as a user reads it, and the remedy; one that is not meant for users has its kind."""
    if type(error).__module__.split(".")[0] in OUR_PACKAGES:
        return str(error), getattr(error, "remedy", "")
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}", ""
    return f"{method} failed: {type(error).__name__}: {error}", "a defect of rtid: please report it"


class Worker:
    """The server's side: `ask` returns at once, answers arrive through `on_loop`.

    on_loop: calls something on the thread that asks; it must be there before the first job is.
    """

    def __init__(self, on_loop: OnLoop | None = None) -> None:
        self.on_loop = on_loop
        self._jobs: list[Job] = []
        self._pipe: Connection | None = None
        self._process: BaseProcess | None = None
        self._listener: threading.Thread | None = None
        self._folder: TemporaryDirectory[str] | None = None
        self._stop: Event | None = None

    @property
    def is_busy(self) -> bool:
        """True while a job is waited for."""
        return bool(self._jobs)

    def ask(
        self,
        method: str,
        *arguments: Any,
        then: Then,
        failed: Callable[[RtidError], None],
        progress: Progress = lambda text, share: None,
    ) -> None:
        """Queue a job; call from the loop's thread."""
        self._jobs.append(Job(method, arguments, then, failed, progress))
        if len(self._jobs) == 1:
            self._begin()

    def is_doing(self, *methods: str) -> bool:
        """Whether the job that is being done is one of these."""
        return bool(self._jobs) and self._jobs[0].method in methods

    def forget(self, *methods: str) -> None:
        """Wait no longer for jobs of these kinds; one that is being done ends when it can."""
        now, later = self._jobs[:1], self._jobs[1:]
        if now and now[0].method in methods:
            now = [replace(now[0], then=ignore, failed=ignore, progress=ignore)]
            if self._stop is not None:
                self._stop.set()
        self._jobs = now + [job for job in later if job.method not in methods]

    def stop(self) -> None:
        """End the process, whatever it does, and wait until nothing of it is left."""
        if self._process is None or self._pipe is None or self._listener is None:
            return
        self._process.terminate()
        self._process.join(5.0)
        self._listener.join(5.0)
        self._pipe.close()
        if self._folder is not None:
            self._folder.cleanup()

    def warm(self) -> None:
        """Start the process ahead of the first job: it imports while others do something else."""
        self._pipe = self._pipe or self._start()

    def _start(self) -> Connection:
        """The process, started with the first job: a page that only looks on needs none."""
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        self._folder = TemporaryDirectory(prefix="rtid-", ignore_cleanup_errors=True)
        self._stop = context.Event()
        given = theirs, Path(self._folder.name), self._stop
        self._process = context.Process(target=serve, args=given, daemon=True)
        self._process.start()
        theirs.close()
        self._listener = threading.Thread(target=self._listen, args=(ours,), daemon=True)
        self._listener.start()
        return ours

    def _begin(self) -> None:
        job = self._jobs[0]
        try:
            self.warm()
            assert self._pipe is not None
            self._pipe.send((job.method, job.arguments))
        except OSError:
            self._take("refused", ENDED)

    def _listen(self, pipe: Connection) -> None:
        """Pass on what the worker says, from a thread of its own."""
        while True:
            try:
                kind, content = pipe.recv()
            except (EOFError, OSError):
                self._hear("refused", ENDED)
                return
            if kind == "done":
                content = content.value()
            self._hear(kind, content)

    def _hear(self, kind: str, content: Any) -> None:
        if self.on_loop is not None:  # without one nobody has asked for anything
            self.on_loop(partial(self._take, kind, content))

    def _take(self, kind: str, content: Any) -> None:
        if not self._jobs:
            return
        if kind == "progress":
            self._jobs[0].progress(*content)
            return
        job = self._jobs.pop(0)
        if self._jobs:
            self._begin()
        if kind == "done":
            job.then(content)
        else:
            job.failed(WorkerError(*content))
