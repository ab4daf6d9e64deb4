"""`rtid export`: write the learned maps for a controller, a spreadsheet or another program."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rtid.estimator.solution import Solution
    from rtid.project import Project

SNAPSHOT = ".npz"


def export(
    source: Annotated[Path, typer.Argument(help="Snapshot (.npz) of `rtid replay`, or a trace.")],
    output: Annotated[Path, typer.Argument(help="File to write: .csv, .json or .npz.")],
    project: Annotated[Path, typer.Option("--project", "-p", help="Project file.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")] = False,
) -> None:
    """Write the learned maps: flow, standard deviation and status over command and pressure drop.

    CSV is a long table at the nodes and centres of the grid; JSON and npz hold everything.
    """
    from rtid.errors import RtidError
    from rtid.estimator.published import publish
    from rtid.mapfiles import FORMATS, provenance, write_map
    from rtid.project import load

    if output.suffix.lower() not in FORMATS:
        remedy = f"end its name in {', '.join(FORMATS)}"
        raise RtidError(f"{output}: unknown format", remedy, exit_code=2)
    loaded = load(project)
    solution = _solution(loaded, source)
    flowmap = publish(solution)
    write_map(output, flowmap, provenance(solution, loaded.name, loaded.digest, source.name))
    cells = {e.name: int((e.status == "valid").sum()) for e in flowmap.edges}
    if as_json:
        print(json.dumps({"schema": 1, "written": str(output), "valid_blocks": cells}))
    else:
        text = ", ".join(f"{name} {count}" for name, count in cells.items())
        print(f"wrote {output}; valid blocks: {text}")


def _solution(project: Project, source: Path) -> Solution:
    """From a snapshot as it is, from a trace by the record path."""
    if source.suffix.lower() == SNAPSHOT:
        from rtid.store import load

        return load(source, project.model, project.digest).solution()
    from rtid.replay import replay

    return replay(project, source).fit.solution
