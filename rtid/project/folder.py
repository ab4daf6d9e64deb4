"""What the command line changes in a project before the daemon runs; where it keeps its state."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rtid.project import Project, load


def configured(project: Project, rate_hz: float | None) -> Project:
    """The project with another rate of the loop, where one is given."""
    if rate_hz is None:
        return project
    daemon = project.sections.daemon.model_copy(update={"rate_hz": rate_hz})
    return replace(project, sections=replace(project.sections, daemon=daemon))


def state_folder(project: Project) -> Path:
    """Where the daemon of this project keeps its state: beside the file unless it says where."""
    folder = project.sections.daemon.folder
    return project.path.parent / (folder or f"{project.path.stem}.state")


def state_of(where: Path) -> Path:
    """The state folder that is meant by a project file, or by the folder itself."""
    return where if where.is_dir() else state_folder(load(where))
