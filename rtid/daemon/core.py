"""The part of the daemon that runs in the loop: frames in, samples learned, copies handed over.

Nothing here waits, writes a file, prints or solves.  What others want done here they leave behind
(`swap`, `worn`), and it is done between two ticks.
"""

from __future__ import annotations

import time
from collections import deque

from firmware_bridge.frames import Frames
from firmware_bridge.sources.live import Source
from rtid.apply.answers import Answers
from rtid.daemon.collector import Collector, LagMeter, ScopeKeeper
from rtid.daemon.health import Health
from rtid.daemon.helper import Helper
from rtid.daemon.jobs import Handover
from rtid.daemon.notify import Notifier
from rtid.estimator.estimator import Estimator
from rtid.estimator.wear import Wear
from rtid.project import Project
from rtid.trace.learner import Learner

BATCH_NS = 200_000_000
KEPT_FRAMES = 2000  # of the last frames, to be dumped on failure
EARLY_S = 0.5  # a disk may take so much more for a save than it took for those before
BACKLOG_TICKS = 20  # so many ticks' frames at once are a backlog
HANDOVER, SWAP, UPKEEP, BACKLOG = "handover", "swap", "upkeep", "backlog"


class Core:
    """The work of one tick; `tick` is called by the loop alone."""

    def __init__(
        self, project: Project, learner: Learner, source: Source, analyst: Helper, number: int = 0
    ) -> None:
        daemon = project.sections.daemon
        self.learner, self.source, self._analyst = learner, source, analyst
        self.notifier = Notifier()
        self.health = Health(project, learner)
        self.lag = LagMeter()
        self.answers: Answers | None = None  # for an apply that cannot read the line itself
        self.number = number  # of the last handover
        self.frames = self.samples = 0
        self.newest_s = 0.0  # time of the newest sample, as in `to_chunk`
        self.last: deque[Frames] = deque()
        self.scope = ScopeKeeper([s.name for s in learner.estimator.model.signals])
        self.swap: Estimator | None = None
        self.worn: Wear | None = None  # of the machine, what was learned is to be carried over
        self.is_proving = False  # the map held has still to foretell: what is learned is a shadow
        self.is_solving = self.is_saving = True  # the analyst, or it is not ready yet
        self.save_s = 0.0  # what a snapshot may take until it is on the disk
        self._kept = 0
        self._collector = Collector(2 + len(learner.estimator.model.signals), daemon.record_mb > 0)
        self._publish_ns, self._store_ns = (
            round(1e9 * s) for s in (daemon.publish_s, daemon.store_s)
        )
        now_ns = time.monotonic_ns()
        self._due_publish_ns, self._due_store_ns = now_ns + self._publish_ns, now_ns
        self._due_store_ns += self._store_ns
        self._due_batch_ns = self._due_watchdog_ns = now_ns
        self._usual = max(10.0, BACKLOG_TICKS * 3e3 / daemon.rate_hz)

    def tick(self, now_ns: int) -> str:
        """Take what has arrived; what was done beyond the usual."""
        done = ""
        if self.swap is not None:
            self._swap_in(self.swap)
            self.hand_over(publish=False, store=True)  # what was taken back is not to be restored
            done = SWAP
        if self.worn is not None:
            self.learner.estimator.carry_over(self.worn)
            self.worn, done = None, UPKEEP
        frames = self.source.read(0.0)
        if len(frames) or frames.refused:
            done = self._take(frames, now_ns) or done
        if now_ns >= self._due_batch_ns:
            self._due_batch_ns = now_ns + BATCH_NS
            self._send_batch()
        if self.learner.learns:
            done = self._hand_over_if_due(now_ns) or done
        if self.notifier.watchdog_s and now_ns >= self._due_watchdog_ns:
            self._due_watchdog_ns = now_ns + round(0.25e9 * self.notifier.watchdog_s)
            self.notifier.tell("WATCHDOG=1")
        return done

    def hand_over(self, publish: bool, store: bool, is_last: bool = False) -> None:
        """Copy the estimator and queue the copy."""
        self._send_batch()  # what the copy knows must not be judged by it
        self.number += 1
        self.is_solving |= publish
        self.is_saving |= store
        copy = self.learner.estimator.copy(with_history=False)
        job = Handover(self.number, copy, publish, store, is_last, self.is_proving)
        self._analyst.put(job, first=not publish)

    def finish(self, publish: bool) -> int:
        """Take what has arrived and the last sample, and hand everything over to be stored.

        The number of the handover that must be on the disk, 0 where there is nothing to store: it
        goes ahead of all that waits, what is to be published behind it.
        """
        frames = self.source.read(0.0)
        if len(frames):
            self._take(frames, time.monotonic_ns())
        self.learner.finish()
        self._send_batch()
        if self.swap is not None:
            self._swap_in(self.swap)
        if not self.samples or (self.is_proving and not self.learner.learns):
            return 0
        self.hand_over(publish=False, store=True, is_last=True)
        last = self.number
        if publish and self.learner.learns and not self.is_proving:
            self.hand_over(publish=True, store=False)
        return last

    def close(self) -> None:
        """Close the sockets to the service manager and to an `rtid apply`."""
        self.notifier.close()
        if self.answers is not None:
            self.answers.close()

    def _send_batch(self) -> None:
        batch = self._collector.take()
        if batch is not None:
            self.scope.add(batch.chunk)
            self._analyst.put(batch)

    def _take(self, frames: Frames, now_ns: int) -> str:
        turns = self.learner.estimator.turns
        chunk = self.learner.push(frames)
        self.frames += len(frames)
        if len(frames):
            self.health.ages.note(now_ns)
            self._keep(frames)
            if self.answers is not None:
                self.answers.take(frames)
        self._collector.add(chunk, frames)
        if len(chunk):
            self.samples += len(chunk)
            self.newest_s = float(chunk[-1, 0])
            origin_us = self.learner.estimator.origin_us or 0
            self.lag.note(origin_us + round(1e6 * chunk[-1, 0]), now_ns // 1000)
        if self.learner.estimator.turns != turns:
            return UPKEEP
        return BACKLOG if len(frames) > self._usual else ""

    def _keep(self, frames: Frames) -> None:
        self.last.append(frames)
        self._kept += len(frames)
        while self._kept > KEPT_FRAMES and len(self.last) > 1:
            self._kept -= len(self.last.popleft())

    def _hand_over_if_due(self, now_ns: int) -> str:
        free = not self.is_solving and not self.is_proving
        publish = free and now_ns >= self._due_publish_ns
        store = not self.is_saving and now_ns >= self._due_store_ns
        if not (publish or store) or not self.samples:
            return ""
        if publish:
            self._due_publish_ns = now_ns + self._publish_ns
        if store:
            # what is on the disk is not to be older than that: the next one takes its time as well
            early_ns = min(round(1e9 * max(self.save_s, EARLY_S)), self._store_ns // 2)
            self._due_store_ns = now_ns + self._store_ns - early_ns
        self.hand_over(publish, store)
        return HANDOVER

    def _swap_in(self, estimator: Estimator) -> None:
        """Go on with another estimate, and with the samples that are kept for the diagnosis."""
        estimator.history = self.learner.estimator.history
        self.learner.estimator, self.swap, self.worn = estimator, None, None
