"""`rtid paper`: every figure and table of the paper from a simulated rig, beside the paper's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.cli.exits import Exit
from rtid.cli.options import AsJson

if TYPE_CHECKING:
    from rtid.paper.result import Part


def paper(
    out: Annotated[Path, typer.Option(help="Pictures and the summary go here.")] = Path(
        "rtid-paper"
    ),
    only: Annotated[
        str | None, typer.Option(help="Parts with commas, e.g. fig3,table1; all without it.")
    ] = None,
    plants: Annotated[
        int, typer.Option(min=1, help="Random machines, where a part takes several.")
    ] = 30,
    seed: Annotated[int, typer.Option(min=0, help="Of noise and motion.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Reproduce the figures and tables of the paper that rtid implements, IMECE2005-79420.

    Simulated machines send CAN frames; what is learned from them stands beside what is true and
    what the paper reports.  Writes pictures (PNG, SVG), paper.md and paper.json.  Exit code 4: a
    figure that is asked for was not reached.
    """
    from rtid.paper import parts
    from rtid.paper.result import all_met
    from rtid.present import progress_bar

    keys = parts.chosen(only)
    with progress_bar(hidden=as_json) as progress:
        done = parts.reproduce(out, keys, progress, seed, plants)
    if as_json:
        print(json.dumps(parts.as_json(done)))
    else:
        for part in done:
            _tell(part)
        print(f"wrote {out / 'paper.md'}")
    if not all_met(done):
        raise typer.Exit(Exit.NEGATIVE)


def _tell(part: Part) -> None:
    print(part.title)
    for measure in part.measures:
        beside = f"paper {measure.paper}" if measure.paper else ""
        goal = "" if measure.met is None else measure.goal + ("" if measure.met else ": MISSED")
        print(f"  {measure.name:52}{measure.text:>12}  {beside:22}{goal}".rstrip())
