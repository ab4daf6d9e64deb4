"""A process beside the daemon: jobs go to it through a bounded queue, its answers come back.

Solving, saving and diagnosing in another thread would hold up python-can's receiver and the loop:
they share one interpreter.  The loop only appends to a queue; when the helper is slow, the oldest
job of a kind that may be dropped goes, and is counted.  A helper that dies is started again.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable

from rtid.daemon import realtime
from rtid.daemon.jobs import Answer, Batch, Handover, Job
from rtid.daemon.pipe import Pipe, pair

QUEUED = 500  # jobs that may wait: a slow disk or a long solve
QUEUED_BYTES = 16 << 20  # ... and what their batches may hold
PATIENCE_S, LOOK_S = 20.0, 0.2  # for its end
RESTART_S = (1.0, 60.0)  # first and longest pause before a helper is started again


class Helper:
    """One `python -m MODULE FD ARGUMENTS...`, by `rtid.daemon.helped`.

    `answer` is called from its own thread.
    failures counts how often it had to be started again; with `ended` it is not, and its end is
    answered by that.  is_real_time: so is the loop, and what is to be saved comes next to it.
    """

    def __init__(
        self,
        module: str,
        arguments: list[str],
        answer: Callable[[Answer], None],
        ended: Answer | None = None,
        is_real_time: bool = False,
    ) -> None:
        self._ended, self._is_real_time = ended, is_real_time
        self._command = [sys.executable, "-m", "rtid.daemon.helped", module]
        self._arguments, self._answer = arguments, answer
        self._jobs: deque[Job] = deque()
        self._bytes = 0  # of the batches among them
        self._wake = threading.Condition()
        self._stopping = False
        self.dropped = self.failures = 0
        self.process: subprocess.Popen[bytes] | None = None
        self._feeder = threading.Thread(target=self._run, name=f"rtid-{module}", daemon=True)
        self._feeder.start()

    def put(self, job: Job, first: bool = False) -> None:
        """Queue a job, with `first` ahead of all that wait; never waits."""
        with self._wake:
            if first:
                self._jobs.appendleft(job)
            else:
                self._jobs.append(job)
            if isinstance(job, Batch):
                self._bytes += job.size_bytes
            while len(self._jobs) > QUEUED or self._bytes > QUEUED_BYTES:
                if not self._drop_one():
                    break
            self._wake.notify()

    @property
    def queued(self) -> int:
        """Jobs that wait."""
        return len(self._jobs)

    def stop(self, patience_s: float = PATIENCE_S) -> bool:
        """Let it finish all jobs, then end it; False if it had to be killed.

        On a busy computer its start alone may take a minute: patience ends with so many seconds of
        processor time, or as many of the clock in which it gets none (a disk that hangs).
        """
        with self._wake:
            self._stopping = True
            self._wake.notify()
        begin_s = newest_s = self._cpu_s()
        moved_s = time.monotonic()
        while time.monotonic() - moved_s < patience_s and newest_s - begin_s < patience_s:
            self._feeder.join(min(LOOK_S, patience_s))
            if not self._feeder.is_alive():
                break
            if (now_s := self._cpu_s()) != newest_s:
                newest_s, moved_s = now_s, time.monotonic()
        process = self.process
        if process is not None and process.poll() is None:
            process.kill()
            process.wait()
            return False
        return not self._feeder.is_alive()

    def _cpu_s(self) -> float:
        """Processor time of the process so far, to the nanosecond; 0 where there is none.

        A process that mostly waits takes less than one of the hundredths that /proc counts in.
        """
        if self.process is None:
            return 0.0
        try:
            return time.clock_gettime(~self.process.pid << 3 | 2)  # as clock_getcpuclockid(3)
        except OSError:
            return 0.0

    def _drop_one(self) -> bool:
        for k, job in enumerate(self._jobs):
            if isinstance(job, Batch):
                del self._jobs[k]
                self._bytes -= job.size_bytes
                self.dropped += len(job.frames) if job.frames is not None else 0
                return True
        return False

    def _run(self) -> None:
        pause_s = RESTART_S[0]
        while not self._stopping or self._jobs:
            started_s = time.monotonic()
            with contextlib.suppress(OSError):
                self._serve()
            if self._stopping:
                return
            if self._ended is not None:
                self._answer(self._ended)
                return
            self.failures += 1
            if time.monotonic() - started_s > RESTART_S[1]:
                pause_s = RESTART_S[0]
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, RESTART_S[1])

    def _serve(self) -> None:
        """Start the process and feed it until it ends or nothing more is to be done."""
        ours, theirs = pair()
        command = [*self._command, str(theirs), *self._arguments]
        self.process = subprocess.Popen(
            command,
            pass_fds=[theirs],
            stdin=subprocess.DEVNULL,
            process_group=0,  # Ctrl-C is for the daemon, which ends its helpers in good order
        )
        os.close(theirs)
        pipe = Pipe(ours)
        listener = threading.Thread(target=self._listen, args=(pipe,), daemon=True)
        try:
            with realtime.hastened():
                listener.start()
                self._feed(pipe, self.process)
            self.process.wait()
        finally:
            listener.join(PATIENCE_S)  # what it has said last
            pipe.close()

    def _feed(self, pipe: Pipe, process: subprocess.Popen[bytes]) -> None:
        """Send what there is to do; what is to be saved must not wait behind other work."""
        while (job := self._next()) is not None:
            if isinstance(job, Handover) and job.store:
                realtime.hasten(process.pid, self._is_real_time)  # it holds the interpreter
            pipe.send(job)
        pipe.send(None)

    def _next(self) -> Job | None:
        """The next job; None when it is time to end."""
        with self._wake:
            while not self._jobs and not self._stopping:
                self._wake.wait(0.5)
                if self.process is not None and self.process.poll() is not None:
                    raise BrokenPipeError("the helper has ended")
            job = self._jobs.popleft() if self._jobs else None
            self._bytes -= job.size_bytes if isinstance(job, Batch) else 0
            return job

    def _listen(self, pipe: Pipe) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                self._answer(pipe.receive())
