"""A ring of recordings: all frames of the last while, and for good those around an alarm.

Segments of SEGMENT_S are BLF files, on their way to disk after each batch; the oldest go when all
together exceed the limit.  An alarm links the present and the former segment into its own folder,
and those that follow within AFTER_S: a link costs nothing and survives the ring.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from firmware_bridge.frames import Frames
from firmware_bridge.sources import blf

SEGMENT_S = 60.0
AFTER_S = 30.0
RETRY_S = 5.0  # so long nothing is tried after the disk has refused
MOST_SEGMENTS = 10_000  # however small they are: a folder has to be listed
MOST_ALARMS = 100  # folders of alarms that are kept
RING, ALARMS = "recording", "alarms"


class Recorder:
    """Writes frames below a folder; OSError where the disk takes no more (and no frame after)."""

    def __init__(
        self, folder: Path, limit_bytes: int, clock_s: Callable[[], float] = time.time
    ) -> None:
        self._ring, self._alarms = folder / RING, folder / ALARMS
        self._limit_bytes, self._clock_s = limit_bytes, clock_s
        self._writer: blf.Writer | None = None
        self._path: Path | None = None
        self._end_us = 0
        self._refused: tuple[OSError, float] | None = None  # what the disk has said, and when
        self._keep: list[tuple[Path, float]] = []  # folders that new segments belong to, until
        self._ring.mkdir(parents=True, exist_ok=True)

    @property
    def path(self) -> str:
        """The present segment, "" before the first frame."""
        return str(self._path or "")

    def write(self, frames: Frames) -> None:
        """Append a batch."""
        if not len(frames):
            return
        if self._refused and 0 <= self._clock_s() - self._refused[1] < RETRY_S:
            raise self._refused[0]
        try:
            self._write(frames)
        except OSError as error:
            self._refused = error, self._clock_s()
            self._give_up()
            raise
        self._refused = None

    def _write(self, frames: Frames) -> None:
        first_us = int(frames.t_us.min())
        if self._writer is None or not self._end_us - 2e6 * SEGMENT_S < first_us < self._end_us:
            self._begin(first_us)
        assert self._writer is not None
        self._writer.write(frames)

    def _give_up(self) -> None:
        """Close the segment that the disk does not take; one without a frame goes."""
        is_empty = self._writer is None or not self._writer.has_frames
        self.close()
        if is_empty and self._path is not None:
            for folder in (self._ring, *(folder for folder, _ in self._keep)):
                (folder / self._path.name).unlink(missing_ok=True)
            self._path = None

    def keep(self, name: str, since_unix_s: float) -> str:
        """Keep what is recorded around now for good; the folder."""
        stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime(since_unix_s))
        folder = self._alarms / f"{stamp}-{name}"
        folder.mkdir(parents=True, exist_ok=True)
        for segment in self._segments()[-2:]:
            _link(segment, folder)
        self._keep.append((folder, self._clock_s() + AFTER_S))
        for old in sorted(self._alarms.iterdir())[:-MOST_ALARMS]:
            shutil.rmtree(old, ignore_errors=True)
        return str(folder)

    def close(self) -> None:
        """Close the present segment; the next batch begins another one."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _begin(self, first_us: int) -> None:
        self.close()
        self._path = None
        self._make_room()
        stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime(first_us * 1e-6))
        path = self._ring / f"{stamp}-{first_us % 1_000_000:06d}.blf"
        self._path = path
        self._writer = blf.Writer(path, first_us - 1_000_000)
        self._end_us = first_us + round(1e6 * SEGMENT_S)
        now_s = self._clock_s()
        self._keep = [(folder, until_s) for folder, until_s in self._keep if until_s > now_s]
        for folder, _ in self._keep:
            _link(path, folder)

    def _make_room(self) -> None:
        """Leave room for one more segment as large as the largest."""
        segments = self._segments()
        sizes = [segment.stat().st_size for segment in segments]
        spare = self._limit_bytes - max(sizes, default=0)
        while segments and (sum(sizes) > spare or len(segments) >= MOST_SEGMENTS):
            segments.pop(0).unlink(missing_ok=True)
            sizes.pop(0)

    def _segments(self) -> list[Path]:
        segments = (path for path in self._ring.glob("*.blf") if path.is_file())
        return sorted(segments, key=lambda path: path.stat().st_mtime)


def _link(segment: Path, folder: Path) -> None:
    target = folder / segment.name
    if not target.exists():
        os.link(segment, target)
