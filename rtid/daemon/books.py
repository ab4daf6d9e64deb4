"""What the analyst writes down beside its snapshots: frames, history, alarms.

The disk may refuse anything: that is told once in a while, and tried again with the next job; that
it takes it again is told once.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from firmware_bridge.frames import Frames
from rtid.daemon import jobs
from rtid.daemon.chronicle import Chronicle
from rtid.daemon.recorder import Recorder

T = TypeVar("T")
FLOOD_S = 10.0  # the same refusal of the disk is told at most this often


class Books:
    """Writes into `folder`; limit_bytes: of recorded frames, 0 for none."""

    def __init__(
        self, folder: Path, limit_bytes: int, answer: Callable[[jobs.Answer], None]
    ) -> None:
        self._folder, self._limit_bytes, self._answer = folder, limit_bytes, answer
        self._recorder: Recorder | None = None
        self._chronicle: Chronicle | None = None
        self._segment = ""
        self._told: dict[str, float] = {}
        self._well: set[str] = set()  # what the disk has taken since it has last refused it

    def record(self, frames: Frames) -> None:
        """Keep frames; another file than before is told."""
        if not self._limit_bytes:
            return
        self.put("recording", lambda: self._record().write(frames))
        if self._recorder is not None and self._recorder.path != self._segment:
            self._segment = self._recorder.path
            self._answer(jobs.RecorderState(self._segment))

    def note(self, note: jobs.Note) -> None:
        """Write down an alarm, and keep what was recorded about it."""
        self.write(lambda history: history.note_alarm(note.alarm))
        if note.keep and self._limit_bytes:
            alarm = note.alarm
            keep = self.put(
                "recording", lambda: self._record().keep(alarm.name, alarm.since_unix_s)
            )
            kept = {alarm.name: keep} if keep else {}
            self._answer(jobs.RecorderState(self._recorder.path if self._recorder else "", kept))

    def write(self, entry: Callable[[Chronicle], object]) -> None:
        """An entry of the machine's history, which is opened for the first one."""
        self.put("history", lambda: entry(self._history()))

    def close(self) -> None:
        """Close the files."""
        if self._recorder is not None:
            self._recorder.close()
        if self._chronicle is not None:
            self._chronicle.close()

    def put(self, what: str, action: Callable[[], T]) -> T | None:
        """Do something with the disk; a refusal is told, and tried again with the next job."""
        try:
            result = action()
        except (OSError, sqlite3.Error) as error:
            self.refused(what, str(error))
            return None
        self.took(what)
        return result

    def refused(self, what: str, reason: str) -> None:
        """Tell what could not be done."""
        now_s = time.monotonic()
        if what in self._well or now_s >= self._told.get(what, 0.0):
            self._told[what] = now_s + FLOOD_S
            self._answer(jobs.NotSaved(what, reason))
        self._well.discard(what)

    def took(self, what: str) -> None:
        """Told once: also by a process that knows nothing of what the one before was refused."""
        if what not in self._well:
            self._well.add(what)
            self._answer(jobs.SavedAgain(what))

    def _record(self) -> Recorder:
        if self._recorder is None:
            self._recorder = Recorder(self._folder, self._limit_bytes)
        return self._recorder

    def _history(self) -> Chronicle:
        if self._chronicle is None:
            self._chronicle = Chronicle(self._folder)
        return self._chronicle
