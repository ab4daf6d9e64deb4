"""`rtid trust`: let the Python that a project brings along run on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.exits import Exit
from rtid.errors import RtidError


def trust(
    file: Annotated[
        Path, typer.Argument(help="Project file with effects in Python, or that Python file.")
    ],
    forget: Annotated[bool, typer.Option("--forget", help="Trust it no more.")] = False,
) -> None:
    """Trust a project's Python, exactly as it stands now: read it first, it runs as you.

    No command runs code that a project brings along unless you have said so here; what has changed
    since is not trusted.  Formulas need no trust: they cannot do anything but compute.
    """
    from rtid.project import trust as trusted

    python = _python_of(file)
    if forget:
        was = trusted.forget(python)
        print(f"{python}: {'is not trusted any more' if was else 'was not trusted'}")
        return
    trusted.trust(python)
    print(f"{python}: trusted as it is now; rtid trust --forget takes that back")


def _python_of(file: Path) -> Path:
    """The file itself, or the Python file that a project names."""
    if file.suffix == ".py":
        return file
    from rtid.project import load

    loaded = load(file)
    name = loaded.sections.project.effects_module
    if name is None:
        raise RtidError(f"{file}: names no effects_module: nothing to trust", "", Exit.USAGE)
    return loaded.path.parent / name
