"""`rtid refit`: fit a plant by its equations to a record, and find what its equations miss."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.options import AsJson


def refit(
    plant: Annotated[Path, typer.Argument(help="Plant file (TOML) with the equations.")],
    table: Annotated[Path, typer.Argument(help="Record: CSV, Parquet, .mat.")],
    diagnose: Annotated[
        bool, typer.Option("--diagnose", help="Find the effects that are missing and add them.")
    ] = False,
    add: Annotated[
        list[str] | None,
        typer.Option(
            "--add", help="EFFECT:WHERE, e.g. overflow:x1; may be given twice (see `rtid effects`)."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Fit parameters and initial states of a plant so that its free run follows the record.

    For plants with a state that nobody measures, and for nonlinear parameters.  The validation part
    is never used to fit or to choose: it may only refute an effect that does not help there.  The
    free run begins anew behind each gap of the record.
    """
    from rtid.project.plant_file import load_plant
    from rtid.study.refit import load_records, run
    from rtid.tell.refit import as_json as to_json
    from rtid.tell.refit import tell
    from rtid.tell.replay import progress_bar
    from rtid.tell.terminal import make_console

    keys = tuple(_key(text) for text in add or ())
    file = load_plant(plant)
    records = load_records(file, table)
    with progress_bar() as progress:
        refitted = run(file, records, keys, with_diagnosis=diagnose, progress=progress)
    if as_json:
        print(json.dumps(to_json(refitted)))
    else:
        tell(make_console(), refitted)


def _key(text: str) -> tuple[str, str]:
    effect, _, where = text.partition(":")
    if not (effect and where):
        raise typer.BadParameter(
            f"{text!r} names no effect and place", param_hint="--add EFFECT:WHERE, overflow:x1"
        )
    return effect, where
