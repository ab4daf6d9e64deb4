"""What the command line changes in a project before the daemon runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rtid.project import Project


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
