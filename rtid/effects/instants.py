"""The instants of a record: what is late is late by a time, whatever the steps between samples.

Laws of time (a delay, a lag, a spool of second order) take even samples.  Where a record's are not,
as where messages of several periods make one record or a logger has lost rows, the command, which
is held from each instant to the next, goes through them on an even grid of step h:

    u_j = (U(g_j + h) - U(g_j)) / h,    g_j = t_0 + j h,    U(t) = integral of u.

What comes out is the mean over each interval of the record, again by its integral.  By rows times
the usual step, 10 ms behind steps of 1 to 5 ms were 11.6 +- 0.5, at twice the noise.

Behind a gap nobody knows what was sent before: there everything begins anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rtid.plain import FloatArray, IntArray

UNEVEN = 0.25  # of the usual step, by which another is no longer as long
SHORT, FINEST = 0.05, 0.25  # share of the steps that are shorter than h; h in usual steps, at least
# after which a command is forgotten, steps being no longer; of a record, that is cut off at most
FORGOTTEN_S, QUICK_S, MOST_CUT = 0.2, 0.01, 0.2
Through = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Instants:
    """t_s (n,): of the samples; starts: first samples behind gaps, where a record begins anew."""

    t_s: FloatArray
    starts: IntArray

    @classmethod
    def of(cls, chunk: FloatArray, max_gap_s: float) -> Instants:
        """Those of a record, chunk (n, 2 + signals), SI; max_gap_s: of steps that are no gaps.

        Where a row alone is missing the one before it holds its command for longer.
        """
        steps = np.diff(chunk[:, 0], prepend=chunk[:1, 0])
        usual_s = float(np.median(steps[1:])) if len(steps) > 1 else 0.0
        return cls(chunk[:, 0], np.flatnonzero(steps > max(max_gap_s, usual_s)))

    @cached_property
    def step_s(self) -> float:
        """The usual step, s."""
        return float(np.median(np.diff(self.t_s)))

    @cached_property
    def even_s(self) -> float:
        """Step of the samples that a law is given, s: the usual one where all are as long."""
        if self.is_even:
            return self.step_s
        return max(float(np.quantile(self._steps, SHORT)), FINEST * self.step_s)

    @cached_property
    def is_even(self) -> bool:
        """True where all steps within runs are about as long as the usual one."""
        return bool((np.abs(self._steps - self.step_s) <= UNEVEN * self.step_s).all())

    @cached_property
    def _steps(self) -> FloatArray:
        return np.delete(np.diff(self.t_s), self.starts - 1)

    def over(self, u: FloatArray, law: Through) -> FloatArray:
        """A command (n,), V, behind a law of even samples: its mean over each interval (n,), V."""
        if not len(self.starts):
            return self._of_run(self.t_s, u, law)
        runs = zip(np.split(self.t_s, self.starts), np.split(u, self.starts), strict=True)
        return np.concatenate([self._of_run(t_s, run, law) for t_s, run in runs])

    def _of_run(self, t_s: FloatArray, u: FloatArray, law: Through) -> FloatArray:
        if self.is_even:
            return law(u)
        ends, h = np.append(t_s, t_s[-1] + self.step_s), self.even_s
        grid = ends[0] + h * np.arange(int(np.ceil((ends[-1] - ends[0]) / h)) + 1)
        sent = np.interp(grid, ends, np.append(0.0, np.cumsum(u * np.diff(ends))))
        sent[-1] += u[-1] * max(0.0, grid[-1] - ends[-1])  # held beyond its end
        out = law(np.diff(sent) / h)
        reached = np.interp(ends, grid, np.append(0.0, np.cumsum(out * h)))
        return np.diff(reached) / np.diff(ends)

    @cached_property
    def unknown(self) -> IntArray:
        """Samples (m,) so soon behind a gap that what was sent within it may still act.

        The same for whatever is late: a step of a search must not change which rows count.
        """
        if not len(self.starts):
            return np.zeros(0, np.int64)
        run = np.searchsorted(self.starts, np.arange(len(self.t_s)), "right")
        since = np.where(run > 0, self.t_s - self.t_s[np.append(0, self.starts)][run], np.inf)
        forgotten_s = FORGOTTEN_S * max(1.0, self.step_s / QUICK_S)
        most = int(MOST_CUT * len(since))
        return np.flatnonzero(since < min(forgotten_s, float(np.partition(since, most)[most])))
