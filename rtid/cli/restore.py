"""`rtid restore`: what was learned goes back to a point in time."""

from __future__ import annotations

from typing import Annotated

import typer

from rtid.cli.options import ProjectOption, StateFolder
from rtid.errors import RtidError


def restore(
    project: ProjectOption,
    point: Annotated[
        str, typer.Argument(help="Name of a point in `rtid history`, or its beginning.")
    ],
    state: StateFolder = None,
) -> None:
    """Go back to what was learned at a point in time; the daemon must not run.

    What stands now becomes a point in time itself.  The next `rtid run` begins with the restored
    maps, which must first foretell the motion.
    """
    from rtid.apply.reach import is_running
    from rtid.project import load
    from rtid.project.folder import state_folder
    from rtid.study.on_board import on_board
    from rtid.trace.points import named
    from rtid.trace.snapshot import Generations

    loaded = on_board(load(project), lambda _: None)
    folder = state or state_folder(loaded)
    if is_running(folder):
        raise RtidError(f"{folder}: a daemon runs here", "stop it first")
    generations = Generations(folder, loaded.digest)
    chosen = named(generations.folder, point)
    generations.go_back(chosen, loaded.model)
    print(f"{loaded.name}: back at {chosen.path.stem}; what stood before is kept as a point too")
