"""Means of samples over windows of equal length: what is faster than the machine is sensors' noise.

Where the rate of one measurement stands beside another's, noise at 1 kHz hides what both know of a
motion of seconds.  All signals go through the same windows, so that none comes late.  Windows begin
anew behind a gap; one that a gap or the end cuts short is dropped, and one without a sample is a
gap.  The result does not depend on the pieces in which samples arrive.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.samples import GAP, Samples, join


class Averaged:
    """Samples in, their means over windows of step_us microseconds out; 0 lets them through."""

    def __init__(self, step_us: int) -> None:
        self.step_us = step_us
        self._begun: Samples | None = None  # of the window that is not over
        self._origin_us, self._next = 0, -1  # where windows count from; the number that is due

    def push(self, samples: Samples) -> Samples:
        """The means of the windows that these samples (n, signals) end, at their mean instants."""
        if not self.step_us or not len(samples):
            return samples
        if self._begun is not None:
            samples = join([self._begun, samples])
        begin = np.union1d([0], np.flatnonzero(samples.flags & GAP)).tolist()
        ends = [*begin[1:], len(samples)]
        runs = [_rows(samples, *ends_of) for ends_of in zip(begin, ends, strict=True)]
        return join([self._of_run(run, run is runs[-1]) for run in runs])

    def _of_run(self, run: Samples, is_open: bool) -> Samples:
        """The windows of samples without a gap; the last one waits for more, or is dropped."""
        if run.flags[0] & GAP or self._next < 0:
            self._origin_us, self._next = int(run.t_us[0]), -1
        number = (run.t_us - self._origin_us) // self.step_us
        first = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        self._begun = _rows(run, int(first[-1]), len(run)) if is_open else None
        sizes, numbers = np.diff(first), number[first[:-1]]
        before = np.concatenate([[self._next - 1], numbers[:-1]])
        made = _means(run, first, sizes)
        made.flags[numbers != before + 1] |= GAP
        if len(numbers):
            self._next = int(numbers[-1]) + 1
        return made


def _means(run: Samples, first: NDArray[np.intp], sizes: NDArray[np.intp]) -> Samples:
    """Of all windows but the last; first: where each begins, sizes: how many samples it has."""
    if not len(sizes):
        return _rows(run, 0, 0)
    at, until, begun_us = first[:-1], int(first[-1]), run.t_us[first[:-1]]
    since_us = run.t_us[:until] - np.repeat(begun_us, sizes)
    t_us = np.asarray(begun_us + np.add.reduceat(since_us, at) // sizes, np.int64)
    values = np.add.reduceat(run.values[:until], at, axis=0) / sizes[:, None]
    flags = np.bitwise_or.reduceat(run.flags[:until], at) & ~np.uint8(GAP)
    return Samples(run.names, t_us, values, flags)


def _rows(samples: Samples, start: int, stop: int) -> Samples:
    cut = slice(start, stop)
    return Samples(samples.names, samples.t_us[cut], samples.values[cut], samples.flags[cut])
