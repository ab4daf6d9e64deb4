"""`rtid replay`: learn from a captured trace, as on board, and say what was learned."""

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
    PriorOption,
    ProjectOption,
    TracesArgument,
    UnitsOption,
)
from rtid.units import System

if TYPE_CHECKING:
    from rtid.tell.replay import LearnedStory


def replay(
    trace: TracesArgument,
    project: ProjectOption,
    bus: Annotated[
        bool, typer.Option("--bus", help="Through python-can's virtual bus instead of the file.")
    ] = False,
    speed: Annotated[
        float, typer.Option(help="With --bus: times real time; 0: as fast as possible.")
    ] = 0.0,
    snapshot: Annotated[
        Path | None,
        typer.Option(help="Write what was learned (.npz) here, to go on from or to export."),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="Show beside the learned map: data sheet (CSV), .npz or .json of `rtid export`.",
        ),
    ] = None,
    prior_map: PriorOption = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for pictures: coverage, maps, model and residual.")
    ] = None,
    picture_format: PictureFormat = "png",
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
    no_cache: NoCache = False,
) -> None:
    """Learn flow maps and bulk modulus from a captured trace.

    Prints what the trace holds, what the gates refused, the bulk modulus with its interval and the
    maps; the same frames give the same snapshot, bit for bit, from the file or from a bus.  Effects
    that `rtid add` has added are in the model: the maps are learned beside them.  Exit code 4: what
    was learned is impossible, and is said to be invalid.
    """
    from rtid.maps.prior_map import find_prior, said_of, with_prior
    from rtid.project import load
    from rtid.study.compared import compare_trace, find_reference
    from rtid.study.known_effects import as_json as added_json
    from rtid.study.study import Study
    from rtid.tell.records import record_lines, records_json
    from rtid.tell.replay import LearnedStory, progress_bar
    from rtid.trace.snapshot import save

    loaded = with_prior(load(project), prior_map)
    prior = find_prior(loaded)  # refused before the work, not after it
    with progress_bar() as progress:
        pace = (speed or float("inf")) if bus else None
        study = Study(loaded, trace, progress, pace)
        result = study.replay
    if snapshot is not None:
        save(snapshot, result.live, loaded.digest)
    learned = LearnedStory(compare_trace(result, find_reference(loaded, reference)))
    written = learned.draw(pictures, picture_format) if pictures else []
    if as_json:
        more = {"added": added_json(result.added), "pictures": [str(p) for p in written]}
        print(json.dumps(learned.as_json() | more | records_json(study.record_errors)))
    else:
        _show(learned, [*([snapshot] if snapshot else []), *written])
        for line in record_lines(study.record_errors):
            print(line)
        if prior is not None:
            print(said_of(prior, learned.compared.flowmap))
    refuse_truncated(trace[0], result.trace.counters)
    if any(doubt.is_invalid for doubt in learned.doubts):
        raise typer.Exit(Exit.NEGATIVE)


def _show(learned: LearnedStory, written: list[Path]) -> None:
    """What was learned, and the files that hold it."""
    from rtid.tell.added import sentences
    from rtid.tell.terminal import make_console

    for sentence in sentences(learned.result.added):
        print(sentence)
    console = make_console()
    console.print(learned.story)
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True)
