"""`make paper`: every figure and table of the paper from a simulated rig, beside the paper's."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from rtid.cli.exits import Exit
from rtid.cli.main import carry_out
from rtid.cli.options import AsJson

if TYPE_CHECKING:
    from benchmarks.paper.result import Part


def paper(
    out: Annotated[Path, typer.Option(help="Folder of pictures and summary.")] = Path("out/paper"),
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
    from benchmarks.paper import parts
    from benchmarks.paper.result import all_met
    from rtid.tell.replay import progress_bar

    keys = parts.chosen(only)
    with progress_bar() as progress:
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


def main(arguments: list[str]) -> NoReturn:
    """Run the command line `arguments` and exit, with the exit codes of `rtid`."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(paper)
    carry_out(app, arguments, "benchmarks.paper")


if __name__ == "__main__":
    main(sys.argv[1:])
