"""What the loop keeps for others: batches, the last second of every signal, the age of the newest.

Memory for samples and frames of many ticks is taken beforehand: a tick only copies.  A live page
draws the last second in tenths, smallest and largest value; who tells the status takes them once a
second.  Stamps and arrivals have clocks of their own: the least difference arrival - stamp of the
last 10 to 20 s is a sample that came at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from rtid.daemon.jobs import Batch
from rtid.daemon.status import Scope
from rtid.plain import FloatArray

ROWS = 1024  # at first; it grows where ticks bring more
BINS_PER_S = 10
MOST_CHUNKS = 30  # of a teller that does not come
DIGITS = 5
WINDOW_US = 10_000_000


class Collector:
    """Rows as in `to_chunk`, columns wide; frames only where they are to be recorded."""

    def __init__(self, columns: int, with_frames: bool) -> None:
        self._columns, self._with_frames = columns, with_frames
        self._rows, self._room = ROWS, ROWS
        self._chunk, self._frames = np.empty((ROWS, columns)), fr.empty(ROWS)
        self._n = self._m = 0

    def add(self, chunk: FloatArray, frames: Frames) -> None:
        """Copy what one tick brought; chunk (n, 2 + signals), SI."""
        n = len(chunk)
        if self._n + n > len(self._chunk):
            room = np.empty((2 * (n + ROWS), self._columns))
            self._chunk = np.concatenate([self._chunk[: self._n], room])
        self._chunk[self._n : self._n + n] = chunk
        self._n += n
        if self._with_frames:
            self._add_frames(frames)

    def take(self) -> Batch | None:
        """Everything since the last time; None if that is nothing."""
        if not (self._n or self._m):
            return None
        frames = self._frames[: self._m] if self._with_frames else None
        batch = Batch(self._chunk[: self._n], frames)
        self._rows, self._room = max(ROWS, 2 * self._n), max(ROWS, 2 * self._m)
        self._chunk = np.empty((self._rows, self._columns))
        self._frames = fr.empty(self._room)
        self._n = self._m = 0
        return batch

    def _add_frames(self, frames: Frames) -> None:
        m, at = len(frames), self._m
        if at + m > len(self._frames):
            self._frames = fr.concatenate([self._frames[:at], fr.empty(2 * (m + ROWS))])
        for mine, new in (
            (self._frames.t_us, frames.t_us),
            (self._frames.channel, frames.channel),
            (self._frames.can_id, frames.can_id),
            (self._frames.length, frames.length),
            (self._frames.data, frames.data),
        ):
            mine[at : at + m] = new
        self._m += m


class ScopeKeeper:
    """Takes chunks (n, 2 + signals), SI, of the loop's thread, and gives them up to another."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._chunks: deque[FloatArray] = deque(maxlen=MOST_CHUNKS)

    def add(self, chunk: FloatArray) -> None:
        """Rows (n, 2 + signals), SI, that nobody changes any more."""
        self._chunks.append(chunk)

    def take(self) -> Scope:
        """All rows since the last time, in tenths of a second."""
        chunks = [self._chunks.popleft() for _ in range(len(self._chunks))]
        rows = np.concatenate([c for c in chunks if len(c)] or [np.empty((0, 2))])
        if not len(rows):
            return Scope()
        number = np.floor(BINS_PER_S * rows[:, 0])
        first = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        low, high = (f.reduceat(rows[:, 2:], first, axis=0) for f in (np.minimum, np.maximum))
        t_s = tuple((number[first] / BINS_PER_S).tolist())
        return Scope(t_s, self._by_name(low), self._by_name(high))

    def _by_name(self, values: FloatArray) -> dict[str, tuple[float, ...]]:
        return {
            name: tuple(float(f"{v:.{DIGITS}g}") for v in column)
            for name, column in zip(self._names, values.T, strict=True)
        }


class LagMeter:
    """`note` each newest stamp with the time at which it was taken, us on the loop's clock."""

    def __init__(self) -> None:
        self._least: int | None = None
        self._before: int | None = None
        self._since_us = 0
        self._stamp_us = 0

    def note(self, stamp_us: int, now_us: int) -> None:
        """A sample of this stamp was learned now."""
        self._stamp_us = stamp_us
        late_us = now_us - stamp_us
        if self._least is None or late_us < self._least:
            self._least = late_us
        if now_us - self._since_us >= WINDOW_US:
            self._before, self._least, self._since_us = self._least, late_us, now_us

    def age_s(self, now_us: int) -> float | None:
        """Seconds since the newest sample was taken by its sensors; None before the first."""
        known = [least for least in (self._least, self._before) if least is not None]
        return max(0.0, (now_us - self._stamp_us - min(known)) * 1e-6) if known else None
