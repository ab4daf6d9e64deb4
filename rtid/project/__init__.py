"""Project files: `load(path)` turns TOML into the machine's `Model` and the bridge's `Assembly`."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtid.project.errors import Problem, ProjectError
    from rtid.project.loading import load
    from rtid.project.project import Project, Sections

_HOMES = {  # imported when asked for: who reads a history need not wait for every section's schema
    "Problem": "errors",
    "Project": "project",
    "ProjectError": "errors",
    "Sections": "project",
    "load": "loading",
}
__all__ = ["Problem", "Project", "ProjectError", "Sections", "load"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"rtid.project has no {name!r}")
    return getattr(import_module(f"rtid.project.{_HOMES[name]}"), name)
