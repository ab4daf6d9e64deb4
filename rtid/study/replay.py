"""Replay: a captured trace through the same path as on board, then the record path on top."""

from __future__ import annotations

from pathlib import Path

from rtid.errors import door
from rtid.plain import Progress, silent
from rtid.project import Project
from rtid.study.kept_record import Replay
from rtid.study.study import Study

__all__ = ["Replay", "replay"]


@door
def replay(
    project: Project,
    path: str | Path,
    progress: Progress = silent,
    bus_speed: float | None = None,
) -> Replay:
    """Everything that one trace tells, beside the effects that its project has added.

    progress is told what is being done and the share that is done, 0 to 1.  bus_speed: send the
    frames through a virtual bus at so many times their pace (inf: at once) instead of taking them
    from the file; the result is the same, bit for bit.  Raises PartError where the record has no
    column for an effect.
    """
    return Study(project, path, progress, bus_speed).replay
