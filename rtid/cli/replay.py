"""`rtid replay`: learn from a captured trace, as on board, and say what was learned."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.exits import refuse_truncated
from rtid.cli.options import AsJson, PriorOption, ProjectOption


def replay(
    trace: Annotated[
        Path, typer.Argument(help="CAN log (.blf .log .asc .trc .csv .mf4) or table.")
    ],
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
    picture_format: Annotated[str, typer.Option(help="png or svg.")] = "png",
    as_json: AsJson = False,
) -> None:
    """Learn flow maps and bulk modulus from a captured trace.

    Prints what the trace holds, what the gates refused, the bulk modulus with its interval and the
    maps; the same frames give the same snapshot, bit for bit, from the file or from a bus.  Effects
    that `rtid add` has added are in the model: the maps are learned beside them.
    """
    from rtid.beside import as_json as added_json
    from rtid.beside import replay_beside, sentences
    from rtid.comparing import compare_trace, find_reference
    from rtid.present import Story, progress_bar
    from rtid.priors import find_prior, said_of, with_prior
    from rtid.project import load
    from rtid.store import save

    loaded = with_prior(load(project), prior_map)
    prior = find_prior(loaded)  # refused before the work, not after it
    with progress_bar(hidden=as_json) as progress:
        pace = (speed or float("inf")) if bus else None
        result = replay_beside(loaded, trace, progress, bus_speed=pace)
    if snapshot is not None:
        save(snapshot, result.live, loaded.digest)
    story = Story(compare_trace(result, find_reference(loaded, reference)))
    written = story.draw(pictures, picture_format) if pictures else []
    if as_json:
        more = {"added": added_json(result.added), "pictures": [str(p) for p in written]}
        print(json.dumps(story.as_json() | more))
    else:
        for sentence in sentences(result.added):
            print(sentence)
        story.print(snapshot, written)
        if prior is not None:
            print(said_of(prior, story.compared.flowmap))
    refuse_truncated(trace, result.trace.counters)
