"""Project files: `load(path)` turns TOML into the machine's `Model` and the bridge's `Assembly`."""

from rtid.project.errors import Problem, ProjectError
from rtid.project.loading import load
from rtid.project.project import Project, Sections

__all__ = ["Problem", "Project", "ProjectError", "Sections", "load"]
