"""The loop: one piece of work per tick, at absolute deadlines k / rate on the monotonic clock.

A tick that ends after the next deadline is an overrun: the deadlines that passed are skipped, never
made up for, and the cause is counted: what the work says it did ("handover", "upkeep", ...), or
"late" when the tick itself was woken too late, or "preempted" when it did not get the processor.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from rtid.daemon.histogram import Histogram

LATE, PREEMPTED, WORK = "late", "preempted", "work"


@dataclass
class LoopStatistics:
    """Everything that a loop has gone through since it was made."""

    ticks: int = 0
    overruns: int = 0
    skipped: int = 0
    causes: dict[str, int] = field(default_factory=dict)
    lateness: Histogram = field(default_factory=Histogram)
    work: Histogram = field(default_factory=Histogram)


class Loop:
    """Calls `work(now_ns)` at a fixed rate from the calling thread until `stop`.

    work returns what it did beyond the usual, "" for nothing.  `total` counts since the start,
    `last_second` over the last whole second's ticks; other threads may read both.
    """

    def __init__(
        self,
        rate_hz: float,
        work: Callable[[int], str],
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.period_ns = round(1e9 / rate_hz)
        self.total, self.last_second = LoopStatistics(), LoopStatistics()
        self._recent, self._per_second = LoopStatistics(), max(1, round(rate_hz))
        self._work, self._clock_ns, self._sleep = work, clock_ns, sleep
        self._stopped = False

    def stop(self) -> None:
        """End after the present tick; may be called from a signal handler or another thread."""
        self._stopped = True

    def run(self) -> None:
        """Tick until stopped; what `work` raises ends the loop."""
        due_ns = self._clock_ns() + self.period_ns
        while not self._stopped:
            now_ns = self._clock_ns()
            if now_ns < due_ns:
                self._sleep((due_ns - now_ns) * 1e-9)
                now_ns = self._clock_ns()
            due_ns = self._tick(due_ns, now_ns)

    def _tick(self, due_ns: int, start_ns: int) -> int:
        """Work once; the next deadline."""
        if self._recent.ticks == self._per_second:
            self.last_second, self._recent = self._recent, LoopStatistics()
        cpu_ns = time.thread_time_ns()
        done = self._work(start_ns)
        cpu_ns = time.thread_time_ns() - cpu_ns
        end_ns = self._clock_ns()
        for part in (self.total, self._recent):
            part.ticks += 1
            part.lateness.add((start_ns - due_ns) * 1e-3)
            part.work.add((end_ns - start_ns) * 1e-3)
        next_ns = due_ns + self.period_ns
        if end_ns <= next_ns:
            return next_ns
        skipped = (end_ns - next_ns) // self.period_ns + 1
        self._note_overrun(skipped, done or self._cause(due_ns, start_ns, end_ns, cpu_ns))
        return next_ns + skipped * self.period_ns

    def _cause(self, due_ns: int, start_ns: int, end_ns: int, cpu_ns: int) -> str:
        late_ns, away_ns = start_ns - due_ns, end_ns - start_ns - cpu_ns
        if max(late_ns, away_ns) > cpu_ns:
            return LATE if late_ns >= away_ns else PREEMPTED
        return WORK

    def _note_overrun(self, skipped: int, cause: str) -> None:
        for part in (self.total, self._recent):
            part.overruns += 1
            part.skipped += skipped
            part.causes[cause] = part.causes.get(cause, 0) + 1
