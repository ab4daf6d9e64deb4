"""The daemon put together: restore, compile, open the bus, loop, and end in good order.

main thread    the loop: take frames, learn, hand copies over        (SCHED_FIFO if wished)
rtid-receive   only queues what the bus delivers
rtid-keeper    hears answers, raises alarms, tells the status
analyst        a process: solves, publishes, judges, records, saves
diagnoser      a process per diagnosis, and per question to the coach
"""

from __future__ import annotations

import contextlib
import signal
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from firmware_bridge import frames as fr
from firmware_bridge.sources import candump
from firmware_bridge.sources.live import Source
from rtid.apply.answers import answers_of
from rtid.apply.reach import LOCK_FILE
from rtid.daemon import realtime
from rtid.daemon.coaching import Coaching
from rtid.daemon.core import Core
from rtid.daemon.diagnosing import Diagnosing
from rtid.daemon.helper import Helper
from rtid.daemon.jobs import Answer, NotSaved, SavedSnapshot
from rtid.daemon.keeper import Keeper
from rtid.daemon.log import logger
from rtid.daemon.loop import Loop
from rtid.daemon.notices import telling
from rtid.daemon.status import Status
from rtid.daemon.teller import Facts
from rtid.daemon.warm import compiled
from rtid.errors import RtidError
from rtid.project import Project
from rtid.study.on_board import on_board
from rtid.trace.described import catalog_of
from rtid.trace.learner import Learner
from rtid.trace.snapshot import Generations
from rtid.trace.state_files import locked

ANALYST = "rtid.daemon.analyst"


class DaemonError(RtidError):
    """The daemon cannot begin; the text says what to change."""


@dataclass(frozen=True)
class Bus:
    """How to open the bus: `open` is called once everything is compiled."""

    interface: str
    channel: str
    open: Callable[[], Source]


class Daemon:
    """One machine, one bus, one state folder."""

    def __init__(
        self,
        project: Project,
        bus: Bus,
        folder: Path,
        log_every_s: float = 1.0,
        is_fresh: bool = False,
    ) -> None:
        if project.noise_unseen:
            names = ", ".join(project.noise_unseen)
            raise DaemonError(
                f"{project.path}: the noise of {names} is to be estimated; on board it is needed",
                "`rtid quick TRACE --save` writes it; or write what `rtid check` tells of it",
            )
        self._project, self._bus, self._folder = project, bus, folder
        self._board = on_board(project, logger.warning)  # with the added effects that can run live
        self._log_every_s = log_every_s
        self._is_fresh = is_fresh  # do not go on with what the folder holds
        self._generations = Generations(folder, self._board.digest)
        self._loop: Loop | None = None
        self._keeper: Keeper | None = None
        self._stopping = False
        self._answers: deque[Answer] = deque()  # of the helpers, for the keeper
        self._saved = 0  # the newest handover that is on the disk
        self.is_saved = True  # after the end: whether the last state is

    @property
    def status(self) -> Status | None:
        """The newest status; None before the bus is open."""
        return self._keeper.status if self._keeper is not None else None

    @property
    def _priority(self) -> int:
        return self._project.sections.daemon.priority

    def stop(self) -> None:
        """End in good order, from any thread or a signal handler, also before the bus is open."""
        self._stopping = True
        if self._loop is not None:
            self._loop.stop()

    def run(self, for_s: float | None = None) -> Status:
        """Run until stopped, or for so many seconds; the last status.

        Raises DaemonError, SourceError where the bus cannot be opened or has failed for good.
        """
        realtime.share_arenas()
        folder = self._folder
        folder.mkdir(parents=True, exist_ok=True)
        other = f"{folder}: another daemon keeps its state here"
        with locked(folder / LOCK_FILE, DaemonError(other, "stop it, or name a folder")):
            learner = compiled(self._learner)
            restored = self._restore(learner)
            words, priority = [str(self._project.path), str(folder)], self._priority
            analyst = Helper(ANALYST, words, self._hear, is_real_time=priority > 0)
            diagnosing = Diagnosing(self._project, self._answers.append)
            coaching = Coaching(self._project, self._generations.folder, self._answers.append)
            try:
                with self._bus.open() as source:
                    core = Core(self._project, learner, source, analyst)
                    core.answers = answers_of(self._project, folder, self._bus.interface)
                    facts = Facts(
                        self._project,
                        folder,
                        self._bus.interface,
                        self._bus.channel,
                        restored,
                        *self._prepare(),
                        time.time(),
                        self._log_every_s,
                        self._generations.folder,
                    )
                    self._keeper = Keeper(facts, core, analyst, diagnosing, coaching, self._answers)
                    bus = self._bus.interface, self._bus.channel
                    with telling(self._project, bus, folder, lambda: self.status):
                        return self._run(core, analyst, for_s)
            finally:
                diagnosing.stop()
                coaching.stop()
                analyst.stop(0.0)

    def _run(self, core: Core, analyst: Helper, for_s: float | None) -> Status:
        """Loop, then store what was learned."""
        keeper = self._keeper
        assert keeper is not None
        rate_hz = self._project.sections.daemon.rate_hz
        end_ns = time.monotonic_ns() + round(1e9 * for_s) if for_s is not None else None
        self._loop = loop = Loop(rate_hz, _until(core.tick, end_ns, self.stop))
        keeper.teller.loop = loop
        keeper.start()
        logger.info("running %s on %s %s at %g Hz", self._project.name, self._bus.interface,
                    self._bus.channel, rate_hz)  # fmt: skip
        try:
            if not self._stopping:
                loop.run()
        except BaseException:
            self._dump(core)
            raise
        finally:
            try:
                self._finish(core, analyst, publish=for_s is not None)
            finally:  # also where what failed the loop fails the end: nobody else ends its thread
                keeper.stop()
                core.close()
            logger.info("stopped")
        return keeper.status

    def _finish(self, core: Core, analyst: Helper, publish: bool) -> None:
        """Hear no more, take what is there, and have it stored."""
        core.notifier.tell("STOPPING=1")
        core.source.stop()
        last = core.finish(publish)
        if not analyst.stop():
            logger.warning("the helper was ended before it had done everything")
        self.is_saved = self._saved >= last
        if not self.is_saved:
            logger.error("NOT SAVED: the last state is not on the disk")
            self._answers.append(NotSaved("last state", "it is not on the disk"))

    def _hear(self, answer: Answer) -> None:
        """From the analyst, in its listener's thread."""
        if isinstance(answer, SavedSnapshot):
            self._saved = answer.number
        self._answers.append(answer)

    def _learner(self) -> Learner:
        board = self._board
        return Learner(board.model, catalog_of(board), board.assembly, board.flows)

    def _restore(self, learner: Learner) -> str:
        """Go on with the newest whole snapshot of this project."""
        if self._is_fresh:
            self._generations.set_aside("fresh")
        restored = self._generations.restore(learner.estimator.model)
        for text in restored.refused:
            logger.warning("refused %s", text)
        if restored.estimator is not None:
            restored.estimator.history = learner.estimator.history
            learner.estimator = restored.estimator
        logger.info("state %s", restored.text)
        return restored.text

    def _prepare(self) -> tuple[str, bool]:
        """Scheduling and memory of the loop's thread, as far as the system grants it."""
        priority = self._priority
        realtime.settle_interpreter()
        realtime.sharpen_timer()
        if not priority:
            return "other", False
        locked = realtime.lock_memory()
        granted = realtime.promote(priority)
        if not (granted and locked):
            logger.warning("priority %d: scheduling granted=%s, memory locked=%s; needs "
                           "CAP_SYS_NICE and CAP_IPC_LOCK", priority, granted, locked)  # fmt: skip
        return (f"fifo {priority}" if granted else "other"), locked

    def _dump(self, core: Core) -> None:
        """Keep the last frames and the reason of a failure."""
        stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
        with contextlib.suppress(OSError):
            (self._folder / f"failure-{stamp}.txt").write_text(traceback.format_exc(), "utf-8")
            candump.write(self._folder / f"failure-{stamp}.log", fr.concatenate(list(core.last)))
            logger.error("failed; the last frames are in %s/failure-%s.log", self._folder, stamp)


def _until(
    tick: Callable[[int], str], end_ns: int | None, stop: Callable[[], None]
) -> Callable[[int], str]:
    """The tick, which stops the loop at end_ns."""
    if end_ns is None:
        return tick

    def timed(now_ns: int) -> str:
        if now_ns >= end_ns:
            stop()
        return tick(now_ns)

    return timed


@contextlib.contextmanager
def stopped_by_signals(daemon: Daemon) -> Iterator[None]:
    """SIGTERM, SIGINT and SIGHUP end the daemon in good order; only from the main thread.

    SIGHUP stays ignored where it is, as by nohup.
    """

    def stop(_number: int, _frame: FrameType | None) -> None:
        daemon.stop()

    wanted = [signal.SIGTERM, signal.SIGINT]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        wanted.append(signal.SIGHUP)
    before = {number: signal.signal(number, stop) for number in wanted}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
