"""`rtid diagnose`: which physical effect is missing in the model of a captured trace."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.cli.exits import Exit, refuse_truncated
from rtid.cli.options import (
    AsJson,
    NoCache,
    PictureFormat,
    ProjectOption,
    TracesArgument,
    UnitsOption,
)
from rtid.units import System

if TYPE_CHECKING:
    from rtid.tell.story import Chart


def diagnose(
    trace: TracesArgument,
    project: ProjectOption,
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for pictures of the evidence.")
    ] = None,
    picture_format: PictureFormat = "png",
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
    no_cache: NoCache = False,
) -> str:
    """Say which physical effect is missing, how large it is, and what could not be seen.

    Verdicts: matches, missing (an effect has a name), ambiguous (one of a set), unknown (something
    is missing that no known effect explains), insufficient_data.  Exit code 4: a bulk modulus is
    impossible, and is said to be invalid.
    """
    from rtid.study.study import Study
    from rtid.tell.charts.evidence import charts_of
    from rtid.tell.diagnosed import story
    from rtid.tell.records import record_lines, records_json
    from rtid.tell.replay import progress_bar
    from rtid.tell.terminal import make_console

    with progress_bar() as progress:
        study = Study(project, trace, progress)
        diagnosed = study.diagnosis()
        told = pictures or not as_json
        evidence = charts_of(study.evidence, study.remainder) if told else ()
    written = _drawn(evidence, pictures, picture_format) if pictures else []
    if as_json:
        more = {"pictures": [str(path) for path in written]} if pictures else {}
        of = {"trace": str(study.path)} | records_json(study.record_errors)
        print(json.dumps(of | diagnosed.as_json() | more))
    else:
        console = make_console()
        console.print(story(diagnosed, evidence))
        for line in record_lines(study.record_errors):
            console.print(line)
        for path in written:
            print(f"wrote {path}")
    refuse_truncated(study.path, study.counters)
    if any(doubt.is_invalid for doubt in diagnosed.doubts):
        raise typer.Exit(Exit.NEGATIVE)
    return diagnosed.verdict


def _drawn(charts: tuple[Chart, ...], folder: Path, suffix: str) -> list[Path]:
    """Every chart as a file of the folder, which is made if it is not there."""
    from rtid.tell import stills

    folder.mkdir(parents=True, exist_ok=True)
    return [stills.save(stills.draw(c), folder / f"{c.name}.{suffix}") for c in charts]
