"""`rtid fleet`: learn and diagnose thousands of traces, resumably; rank the machines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtid.cli.options import AsJson, UnitsOption
from rtid.units import System

if TYPE_CHECKING:
    from rtid.fleet.archive import Archive
    from rtid.fleet.traces import TraceJob


def fleet(
    sources: Annotated[
        list[Path],
        typer.Argument(help="Folders MACHINE/TRACE, or traces; project.toml may lie in."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Results folder; goes on in it.")],
    project: Annotated[
        Path | None, typer.Option("--project", "-p", help="For machines without a project.toml.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes on this machine.")] = 2,
    scheduler: Annotated[str, typer.Option(help="Address of a dask scheduler instead.")] = "",
    diagnose: Annotated[
        bool, typer.Option("--diagnose/--no-diagnose", help="Look for missing effects, too.")
    ] = True,
    retry: Annotated[bool, typer.Option("--retry", help="Try failed traces once more.")] = False,
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
) -> None:
    """Learn from thousands of traces, find the remarkable machines, and what is typical.

    A run that was stopped goes on where it was: no trace twice, none missing.  A trace that fails
    has a row with its error.  Traces of one machine add up to one map; machines of one declaration
    to a typical map with its spread, a reference for the next one.
    """
    from rtid.cli.exits import Exit
    from rtid.fleet.archive import Archive
    from rtid.fleet.merging import machines, ranked, typical, write
    from rtid.fleet.running import run
    from rtid.fleet.traces import find
    from rtid.project import load
    from rtid.tell.fleet import summary, tell

    jobs, copies = find(sources, project)
    archive = Archive(output)
    again = archive.forget_errors() if retry else 0
    _run(run, jobs, archive, as_json, workers=workers, scheduler=scheduler, with_diagnosis=diagnose)
    loaded = [load(path) for path in dict.fromkeys(job.project for job in jobs)]
    fleet_machines = machines(
        archive, {project.machine_digest: project.model for project in loaded}, workers
    )
    types = typical(fleet_machines)
    write(archive, fleet_machines, types)
    rows = archive.rows()
    document = summary(rows, ranked(fleet_machines, types), len(copies), again)
    if as_json:
        print(json.dumps(document))
    else:
        tell(document, output)
    if rows and all(row["error"] for row in rows):
        raise typer.Exit(Exit.INPUT)


def _run(run: Any, jobs: list[TraceJob], archive: Archive, quiet: bool, **how: Any) -> None:
    from rtid.tell.replay import progress_bar

    with progress_bar(hidden=quiet) as progress:
        run(jobs, archive, lambda n, of, last: progress(f"{n} of {of} traces", n / of), **how)
