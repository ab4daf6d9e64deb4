"""`rtid report`: the story of a captured trace as one HTML file, readable without a network."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.exits import refuse_truncated, refuse_without_bokeh
from rtid.cli.options import AsJson, NoCache, ProjectOption


def report(
    trace: Annotated[Path, typer.Argument(help="CAN log or table.")],
    project: ProjectOption,
    output: Annotated[Path, typer.Option("--output", "-o", help="HTML file to write.")] = Path(
        "report.html"
    ),
    png: Annotated[
        Path | None, typer.Option(help="Also write the pictures as PNG files into this folder.")
    ] = None,
    as_json: AsJson = False,
    no_cache: NoCache = False,
) -> None:
    """Write one HTML file that tells what the model misses: verdict, errors, pictures, tables.

    Everything is inside the file: it can be mailed, printed and read with the network off.
    """
    refuse_without_bokeh()
    from rtid.project import load
    from rtid.tell.diagnosed import sentences, with_convention
    from rtid.tell.replay import progress_bar
    from rtid.tell.report_file import report as write_report

    loaded = load(project)
    with progress_bar() as progress:
        written = write_report(loaded, trace, output, progress, png)
    if as_json:
        print(json.dumps(written.as_json()))
    else:
        for sentence in with_convention(sentences(written.told.diagnosed.diagnosis)):
            print(sentence)
        print(f"wrote {output}, {written.size / 1e3:.0f} kB")
        for path in written.pictures:
            print(f"wrote {path}")
    refuse_truncated(trace, written.told.diagnosed.trace.counters)
