"""The story of a record as one HTML file: diagnose, draw, write."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtid.errors import RtidError
from rtid.plain import Progress, silent
from rtid.project import Project
from rtid.tell.report import page, stills
from rtid.tell.report_story import ReportStory, tell
from rtid.tell.stills import save
from rtid.trace.state_files import replacing


@dataclass(frozen=True)
class Reported:
    """A written report."""

    told: ReportStory
    path: Path
    size: int
    pictures: tuple[Path, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """The diagnosis as of `rtid diagnose --json`, and where it came from and went to."""
        story = self.told
        return {
            "trace": str(story.diagnosed.trace.path),
            "trace_sha256": story.trace_sha256,
            "project": str(story.diagnosed.project.path),
            "project_digest": story.diagnosed.project.digest,
            "report": str(self.path),
            "bytes": self.size,
            "pictures": [str(path) for path in self.pictures],
        } | story.diagnosed.diagnosis.as_json()


def report(
    project: Project,
    trace: Path,
    path: Path,
    progress: Progress = silent,
    pictures: Path | None = None,
) -> Reported:
    """Diagnose a trace and write its story to `path`; the file appears whole or not at all.

    pictures: a folder for the same pictures as PNG files, made if it is not there.  Raises
    RtidError, before the long work, where the file cannot be written.
    """
    _refuse_unwritable(path, (trace, project.path))
    story = tell(project, trace, lambda what, share: progress(what, 0.8 * share))
    progress("drawing", 0.8)
    data = page(story).encode()
    _put(path, data)
    drawn = _draw(story, pictures) if pictures else ()
    progress("done", 1.0)
    return Reported(story, path, len(data), drawn)


def _draw(story: ReportStory, folder: Path) -> tuple[Path, ...]:
    """Every picture of the page as a file."""
    folder.mkdir(parents=True, exist_ok=True)
    return tuple(save(figure, folder / f"{name}.png") for name, figure in stills(story).items())


def _refuse_unwritable(path: Path, inputs: tuple[Path, ...]) -> None:
    """RtidError where the report could not be written, or would replace what it is made from."""
    folder = path.resolve().parent
    if not folder.is_dir():
        raise RtidError(f"{folder}: no such folder", "create it first, or name another file", 2)
    if path.is_dir():
        raise RtidError(f"{path} is a folder", f"name a file: -o {path / 'report.html'}", 2)
    if path.resolve() in [other.resolve() for other in inputs]:
        raise RtidError(f"{path} is what the report is made from", "name another file", 2)
    if not os.access(folder, os.W_OK):
        raise RtidError(f"{folder} cannot be written to", "name a file in another folder", 2)


def _put(path: Path, data: bytes) -> None:
    try:
        with replacing(path) as part:
            part.write_bytes(data)
    except OSError as error:
        remedy = "name a file in another folder"
        raise RtidError(f"{path} cannot be written: {error.strerror}", remedy) from None
