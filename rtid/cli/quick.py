"""`rtid quick FILE`: without a project file; is this data good enough, and what is missing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.exits import Exit, refuse_truncated
from rtid.cli.init import write_new
from rtid.cli.options import AsJson, RoleOption, UnitsOption, by_role
from rtid.units import System


def quick(
    file: Annotated[Path, typer.Argument(help="Table (.csv .parquet .mat) or CAN log.")],
    dbc: Annotated[
        Path | None, typer.Option(help="DBC of a CAN log; the built-in one without it.")
    ] = None,
    bore_mm: Annotated[
        float | None, typer.Option("--bore", min=1.0, help="Piston diameter, mm.")
    ] = None,
    rod_mm: Annotated[float | None, typer.Option("--rod", min=0.0, help="Rod, mm.")] = None,
    stroke_mm: Annotated[
        float | None, typer.Option("--stroke", min=1.0, help="Stroke, mm.")
    ] = None,
    dead_volume_l: Annotated[
        float | None,
        typer.Option("--dead-volume", min=1e-4, help="Volume left at either end, hoses too, L."),
    ] = None,
    role: RoleOption = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Write the project of a plant without pressures."),
    ] = None,
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
) -> None:
    """Say within a minute whether this data is good enough, and which effect is missing.

    Guesses the roles of the signals by name, unit and range, takes the grids from the data, and
    states what it assumes of the machine.  A table without pressures is one of a plant whose rate
    follows a command: its neutral, dead band, gains and delay are found.  Exit code 3: the file
    cannot be read, or is of no kind of plant; 4: it is read, and too little for a verdict.
    """
    from rtid.errors import RtidError
    from rtid.study.quick import quick as look
    from rtid.study.quick_machine import Given
    from rtid.study.quick_rate import QuickRate
    from rtid.tell.quick import lines, rate_lines
    from rtid.tell.replay import progress_bar

    if bore_mm is not None and rod_mm is not None and rod_mm >= bore_mm:
        raise RtidError("--rod is not thinner than --bore", "give diameters in mm", Exit.USAGE)
    bore_m, rod_m, stroke_m, dead_volume_m3 = (
        None if value is None else 1e-3 * value
        for value in (bore_mm, rod_mm, stroke_mm, dead_volume_l)
    )
    given = Given(bore_m, rod_m, stroke_m, dead_volume_m3)
    with progress_bar() as progress:
        looked = look(file, dbc, given, progress, by_role(role or []))
    if as_json:
        print(json.dumps(looked.as_json()))
    else:
        of = rate_lines(looked) if isinstance(looked, QuickRate) else lines(looked)
        print("\n".join(of))
    if isinstance(looked, QuickRate):
        write_new(output, looked.text)
    else:
        refuse_truncated(file, {"truncated": int(looked.truncated)})
    if not looked.is_enough:
        raise typer.Exit(Exit.NEGATIVE)
