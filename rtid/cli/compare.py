"""`rtid compare`: see where a model agrees with a trace and where it does not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtid.cli.exits import refuse_truncated
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
    from rtid.study.compared import TraceComparison
    from rtid.study.study import RecordError


Maps = Annotated[
    list[Path] | None,
    typer.Option(
        "--map",
        help="Data sheet (CSV) or map of `rtid export` (.json, .npz) to hold beside the "
        "learned map; may be given twice.",
    ),
]
Against = Annotated[
    Path | None,
    typer.Option(
        help="Another project (.toml) on this trace, or another trace with this project: "
        "the same tables and pictures side by side."
    ),
]
Block = Annotated[
    str | None, typer.Option(help="When was the machine in this block?  EDGE:I,J, from 0.")
]
Span = Annotated[str | None, typer.Option(help="Which blocks was it in then?  T0:T1 in s.")]
Table = Annotated[
    Path | None, typer.Option(help="Write the residuals here: .csv, .parquet or .mat.")
]
Pictures = Annotated[Path | None, typer.Option(help="Folder for pictures.")]


def compare(
    trace: TracesArgument,
    project: ProjectOption,
    maps: Maps = None,
    against: Against = None,
    block: Block = None,
    span: Span = None,
    table: Table = None,
    pictures: Pictures = None,
    picture_format: PictureFormat = "png",
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
    no_cache: NoCache = False,
) -> None:
    """Say how well the learned map, or a data sheet, explains this trace, where and when it fails.

    Learns from the identification part, then holds every map against both parts: the equation
    residual, the simulated pressure (free run, 1 s and 0.1 s ahead), what the residual depends on,
    and whether the model begins to fail.  Effects that `rtid add` has added are in the model.
    """
    from rtid.project import load
    from rtid.study.compared import find_reference
    from rtid.study.study import Study, compare_two
    from rtid.tell.records import record_lines, records_json
    from rtid.tell.replay import progress_bar
    from rtid.tell.residual_table import refuse_format, write_residuals

    if table is not None:
        refuse_format(table)
    place, when = _place(block), _span(span)
    loaded = load(project)
    sheets: list[Path | None] = [*maps] if maps else [None]
    references = [find_reference(loaded, sheet) for sheet in sheets]
    studies: Sequence[TraceComparison]
    errors: tuple[RecordError, ...] = ()
    with progress_bar() as progress:
        if against is None:
            study = Study(loaded, trace, progress)
            studies, errors = [study.comparison(*references)], study.record_errors
        else:
            studies = compare_two(loaded, _single(trace), against, *references, progress=progress)
    written: list[Path] = []
    if pictures is not None:
        from rtid.tell.compared_pictures import draw

        written = draw(studies, pictures, picture_format)
    if table is not None:
        written.append(write_residuals(table, studies))
    if as_json:
        more = {"written": [str(p) for p in written]} | records_json(errors)
        print(json.dumps(_json(studies, place, when) | more))
    else:
        _print(studies, place, when, written)
        for line in record_lines(errors):
            print(line)
    refuse_truncated(trace[0], studies[0].replay.trace.counters)


def _single(traces: list[Path]) -> Path:
    """The one record that another one, or another project, is held against."""
    if len(traces) > 1:
        raise typer.BadParameter("one record at a time", param_hint="--against")
    return traces[0]


Place = tuple[str, int, int]


def _place(text: str | None) -> Place | None:
    """EDGE:I,J as (edge, i, j)."""
    if text is None:
        return None
    edge, _, numbers = text.rpartition(":")
    i, _, j = numbers.partition(",")
    if not (edge and i.isdecimal() and j.isdecimal()):
        raise typer.BadParameter(f"{text!r} is no block", param_hint="--block EDGE:I,J, pa:3,4")
    return edge, int(i), int(j)


def _span(text: str | None) -> tuple[float, float] | None:
    """T0:T1 as two numbers."""
    if text is None:
        return None
    try:
        t0, t1 = (float(part) for part in text.split(":"))
    except ValueError:
        t0, t1 = 1.0, 0.0
    if not t0 < t1:
        raise typer.BadParameter(f"{text!r} is no span", param_hint="--span T0:T1, 12.5:13.0")
    return t0, t1


def _json(
    studies: Sequence[TraceComparison], place: Place | None, when: tuple[float, float] | None
) -> dict[str, Any]:
    from rtid.study.compared import as_json, blocks_in_span, changes, spans_of_block
    from rtid.study.compared_json import deviation
    from rtid.study.known_effects import as_json as added_json

    first = studies[0]
    document = as_json(first) | {"added": added_json(first.replay.added)}
    if len(studies) > 1:
        added = added_json(studies[1].replay.added)
        document["against"] = as_json(studies[1]) | {"added": added}
        document["changes"] = [deviation(d) for d in changes(first, studies[1])]
    if place is not None:
        document["spans_of_block"] = spans_of_block(first, *place)
    if when is not None:
        document["blocks_in_span"] = [vars(visit) for visit in blocks_in_span(first, *when)]
    return document


def _print(
    studies: Sequence[TraceComparison],
    place: Place | None,
    when: tuple[float, float] | None,
    written: list[Path],
) -> None:
    from rtid.tell.added import sentences
    from rtid.tell.compared import of_block, of_span, story
    from rtid.tell.terminal import make_console

    console = make_console()
    if place is not None:
        console.print(of_block(studies[0], *place))
    if when is not None:
        console.print(of_span(studies[0], *when))
    if place is None and when is None:
        for comparison in studies:
            for sentence in sentences(comparison.replay.added):
                console.print(sentence)
        console.print(story(studies))
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True)
