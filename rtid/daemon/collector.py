"""Samples and frames of many ticks as one batch: memory is taken beforehand, a tick only copies."""

from __future__ import annotations

import numpy as np

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from rtid.daemon.jobs import Batch
from rtid.plain import FloatArray

ROWS = 1024  # at first; it grows where ticks bring more


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
