"""When to ask what is missing: now and then, and repeatedly once the plant has changed."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from rtid.daemon.helper import Helper
from rtid.daemon.jobs import Answer, Check, Checked, Diagnose, Job, VerdictAnswer
from rtid.daemon.log import logger
from rtid.daemon.status import Verdict
from rtid.estimator.estimator import Estimator
from rtid.estimator.ring import History
from rtid.plain import FloatArray
from rtid.project import Project

AFTER_CHANGE_S = (20.0, 35.0, 55.0)  # of samples since the change
LEAST_S = 30.0  # of samples for a diagnosis in between
LIMIT_S = 240.0  # a diagnosis that takes longer is given up
BEING_WRITTEN = 100  # rows at most that one tick appends
MATCHES = "matches"
DIAGNOSER = "rtid.daemon.diagnoser"
ENDED = VerdictAnswer(None, "the helper has ended")


class Asking:
    """One question at a time to a process of its own, which is given up where it takes too long."""

    what, limit_s = "diagnosis", LIMIT_S

    def __init__(self, project: Project, answer: Callable[[Answer], None]) -> None:
        self._project, self._answer = project, answer
        self._helper: Helper | None = None
        self._started_s = 0.0

    @property
    def is_running(self) -> bool:
        """Whether a question is open."""
        return self._helper is not None

    def _ask(self, job: Job, ended: Answer) -> None:
        """Begin a process for a job; ended: the answer where it ends without one."""
        self._started_s = time.monotonic()
        self._helper = Helper(DIAGNOSER, [str(self._project.path)], self._answer, ended)
        self._helper.put(job)

    def _is_busy(self) -> bool:
        """Whether a question was open; one that takes too long is ended."""
        if self._helper is None:
            return False
        if time.monotonic() - self._started_s > self.limit_s:
            logger.warning("%s given up after %.0f s", self.what, self.limit_s)
            self.stop()
        return True

    def stop(self) -> None:
        """End a question that is open."""
        if self._helper is not None:
            self._helper.stop(0.0)
            self._helper = None


class Diagnosing(Asking):
    """One diagnosis at a time, or one check of the project file."""

    def __init__(self, project: Project, answer: Callable[[Answer], None]) -> None:
        super().__init__(project, answer)
        self._every_s = project.sections.daemon.diagnose_s
        self._next_s = time.monotonic() + self._every_s
        self._since_s: float | None = None  # sample time of the change
        self._stage = 0
        self.verdict: Verdict | None = None
        self.is_of_change = False
        self.implausible: tuple[str, ...] = ()

    @property
    def is_acquitted(self) -> bool:
        """Whether the last verdict on the present change is that nothing is missing."""
        return self.is_of_change and self.verdict is not None and self.verdict.verdict == MATCHES

    def begin(self, since_s: float) -> None:
        """The plant has changed at this sample time."""
        self._since_s, self._stage, self.is_of_change = since_s, 0, False

    def check(self, recording: str) -> bool:
        """Hold the project file against a recording; False while something else is under way."""
        if self.is_running:
            return False
        self._ask(Check(recording), ENDED)
        return True

    def end(self) -> None:
        """The plant is as before."""
        self._since_s, self.is_of_change = None, False

    def look(self, estimator: Estimator, newest_s: float) -> None:
        """Begin a diagnosis if one is due, give up one that takes too long.

        newest_s: time of the newest sample, as in `to_chunk`.
        """
        if self._is_busy():
            return
        history = estimator.history
        if history is None:
            return
        if self._since_s is not None:
            self._look_at_change(estimator, newest_s - self._since_s)
        elif time.monotonic() >= self._next_s and history.held_s >= LEAST_S:
            self._next_s = time.monotonic() + self._every_s
            self._begin(estimator, history.span_s)

    def take(self, result: VerdictAnswer | Checked) -> None:
        """An answer has come."""
        self.stop()
        if isinstance(result, Checked):
            self.implausible = result.errors
            return
        if result.verdict is None:
            logger.info("no diagnosis: %s", result.reason)
            return
        self.verdict = result.verdict
        self.is_of_change = self._since_s is not None
        logger.info("diagnosis verdict=%s text=%r", result.verdict.verdict, result.verdict.text)

    def _look_at_change(self, estimator: Estimator, held_s: float) -> None:
        if self._stage < len(AFTER_CHANGE_S) and held_s >= AFTER_CHANGE_S[self._stage]:
            self._stage += 1
            self._begin(estimator, held_s)

    def _begin(self, estimator: Estimator, span_s: float) -> None:
        assert estimator.history is not None
        chunk = newest(estimator.history, span_s)[:, : 2 + len(self._project.model.signals)]
        self._ask(Diagnose(self._project.model, chunk), ENDED)


def newest(history: History, span_s: float) -> FloatArray:
    """The last span_s seconds (n, 2 + signals), SI, of a ring that another thread writes to.

    Rows that were overwritten while they were copied stand before a step back of time, one that was
    not yet written stands at the very end; a clock that was set is a step back as well.
    """
    chunk = history.chunk(span_s)
    back = np.flatnonzero(np.diff(chunk[:, 0]) <= 0)
    if len(back) and back[-1] >= len(chunk) - BEING_WRITTEN:
        chunk = chunk[: back[-1] + 1]
        back = back[:-1]
    return chunk[back[-1] + 1 :] if len(back) else chunk
