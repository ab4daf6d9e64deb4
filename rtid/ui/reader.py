"""What a page sees of a record first, its signals, without the weight of what learns from it."""

from __future__ import annotations

from pathlib import Path

from rtid.plain import Progress
from rtid.project import Project, load
from rtid.trace.glance import Curve, glimpse
from rtid.trace.reading import Trace, read_trace


class Reader:
    """What the worker is until it is asked for more than a record's signals (`desk`)."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._read: tuple[Project, Trace] | None = None  # to be opened next

    def read(self, project: Path, trace: Path) -> tuple[Curve, ...]:
        """Read a record, which is then opened: its signals, before anything is learned."""
        self._progress("reading", 0.0)
        loaded = load(project)
        self._read = loaded, read_trace(loaded, trace)
        return glimpse(loaded.model, self._read[1].samples)
