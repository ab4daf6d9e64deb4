"""Means of samples over windows of equal length: what is faster than the machine is sensors' noise.

Where the rate of one measurement stands beside another's, noise at 1 kHz hides what both know of a
motion of seconds.  All signals go through the same windows, so that none comes late.  Windows begin
anew behind a gap; one that a gap or the end cuts short is dropped, and one without a sample is a
gap.  The result does not depend on the pieces in which samples arrive.

What moves a state x between two means, d x / dt = D n, is none of their kind.  With s from 0 to 1
along a window of length T, and means over the windows k and k + 1,

    x(k + 1) - x(k) = D T (mean_k(s n) + mean_k+1((1 - s) n)),

exactly; half the sum of both means of n is over a wider window, and makes D too large by what n
does within T.  Signals `ahead` carry this mean, for which the next window must have ended.  Where n
turns in between it is neither direction's: there the line is broken, as by a gap.  What a pressure
lets flow moves x in the same way, while its own change from mean to mean is what is stored: its
mean ahead is one more signal, of another name.  A pump that stands drives nothing: only where
something turns the pressure counts, which is part of a window where a stroke begins or ends.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.samples import GAP, Samples, join

TURNED = 0.02  # of what turns both ways between two windows: less is one direction's
Floats = NDArray[np.float64]


class Averaged:
    """Samples in, their means over windows of step_us microseconds out; 0 lets them through.

    ahead: signals whose value acts from the mean instant of a window to that of the next, each with
    the name of the signal that carries that mean: its own, or one behind all others.
    """

    def __init__(self, step_us: int, ahead: tuple[tuple[str, str], ...] = ()) -> None:
        self.step_us, self.ahead = step_us, ahead
        self._begun: Samples | None = None  # of the window that is not over
        self._origin_us, self._next = 0, -1  # where windows count from; the number that is due
        self._last: Samples | None = None  # the window that waits for the next one

    def push(self, samples: Samples) -> Samples:
        """The means of the windows that these samples (n, signals) end, at their mean instants."""
        if not self.step_us:
            return samples
        samples = _with_moments(samples, self.ahead)
        if not len(samples):
            return self._looking_ahead(samples)
        if self._begun is not None:
            samples = join([self._begun, samples])
        begin = np.union1d([0], np.flatnonzero(samples.flags & GAP)).tolist()
        ends = [*begin[1:], len(samples)]
        runs = [_rows(samples, *ends_of) for ends_of in zip(begin, ends, strict=True)]
        made = join([self._of_run(run, run is runs[-1]) for run in runs])
        return self._looking_ahead(made)

    def _of_run(self, run: Samples, is_open: bool) -> Samples:
        """The windows of samples without a gap; the last one waits for more, or is dropped."""
        if run.flags[0] & GAP or self._next < 0:
            self._origin_us, self._next = int(run.t_us[0]), -1
        number = (run.t_us - self._origin_us) // self.step_us
        first = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        self._begun = _rows(run, int(first[-1]), len(run)) if is_open else None
        sizes, numbers = np.diff(first), number[first[:-1]]
        before = np.concatenate([[self._next - 1], numbers[:-1]])
        made = _means(run, first, sizes, 2 * len(self.ahead))
        made.flags[numbers != before + 1] |= GAP
        if len(numbers):
            self._next = int(numbers[-1]) + 1
        return made

    def _looking_ahead(self, made: Samples) -> Samples:
        """All windows but the newest, with the means ahead; made: with moments behind them."""
        if not self.ahead:
            return made
        if self._last is not None:
            made = join([self._last, made])
        self._last = _rows(made, len(made) - 1, len(made)) if len(made) else None
        n = len(made.names) - 4 * len(self.ahead)
        is_own = np.array([signal == name for signal, name in self.ahead])
        plain, size, late, late_size = np.split(made.values[:, n:], 4, axis=1)
        ahead = late[:-1] + (plain - late)[1:]
        size = late_size[:-1] + (size - late_size)[1:]
        goes_on = (made.flags[1:] & GAP) == 0
        values, flags = made.values[:-1, :n].copy(), made.flags.copy()
        moved = np.where(goes_on[:, None], ahead, plain[:-1])
        own = [made.names.index(signal) for signal, name in self.ahead if signal == name]
        values[:, own] = moved[:, is_own]
        turned = (np.abs(ahead) < (1.0 - TURNED) * size)[:, is_own].any(axis=1)
        flags[1:][goes_on & turned] |= GAP
        if self._last is not None:
            self._last = replace(self._last, flags=flags[-1:])
        more = [name for signal, name in self.ahead if signal != name]
        values = np.hstack([values, moved[:, ~is_own]])
        return Samples((*made.names[:n], *more), made.t_us[:-1], values, flags[:-1])


def _with_moments(samples: Samples, ahead: tuple[tuple[str, str], ...]) -> Samples:
    """The samples with what signals move and its size, twice: once to be weighed in a window."""
    if not ahead:
        return samples
    at = [samples.names.index(signal) for signal, _ in ahead]
    is_own = np.array([signal == name for signal, name in ahead])
    moving = samples.values[:, at].copy()
    turns = (moving[:, is_own] != 0.0).any(axis=1)
    moving[:, ~is_own] *= turns[:, None]
    values = np.hstack([samples.values, *2 * [moving, np.abs(moving)]])
    names = (*samples.names, *4 * [signal for signal, _ in ahead])
    return Samples(names, samples.t_us, values, samples.flags)


def _means(run: Samples, first: NDArray[np.intp], sizes: NDArray[np.intp], weighed: int) -> Samples:
    """Of all windows but the last; first: where each begins, sizes: how many samples it has.

    The last `weighed` columns count by how far along its window each sample stands.
    """
    if not len(sizes):
        return _rows(run, 0, 0)
    at, until, begun_us = first[:-1], int(first[-1]), run.t_us[first[:-1]]
    since_us = run.t_us[:until] - np.repeat(begun_us, sizes)
    t_us = np.asarray(begun_us + np.add.reduceat(since_us, at) // sizes, np.int64)
    values: Floats = run.values[:until].copy()
    along = (np.arange(until) - np.repeat(at, sizes) + 0.5) / np.repeat(sizes, sizes)
    values[:, values.shape[1] - weighed :] *= along[:, None]
    means = np.add.reduceat(values, at, axis=0) / sizes[:, None]
    flags = np.bitwise_or.reduceat(run.flags[:until], at) & ~np.uint8(GAP)
    return Samples(run.names, t_us, means, flags)


def _rows(samples: Samples, start: int, stop: int) -> Samples:
    cut = slice(start, stop)
    return Samples(samples.names, samples.t_us[cut], samples.values[cut], samples.flags[cut])
