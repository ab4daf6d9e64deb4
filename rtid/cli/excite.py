"""`rtid excite`: design the motion that identifies the machine, and predict what it will tell."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.options import AsJson, ProjectOption, UnitsOption
from rtid.units import System


def excite(
    project: ProjectOption,
    out: Annotated[
        Path | None, typer.Option(help="CSV for the controller, one row per millisecond.")
    ] = None,
    see: Annotated[
        list[str] | None,
        typer.Option(help="Effect that is to become visible; may be given several times."),
    ] = None,
    after: Annotated[
        Path | None,
        typer.Option(help="Snapshot (.npz) or trace: design what is still missing after it."),
    ] = None,
    duration_s: Annotated[
        float | None,
        typer.Option(
            "--duration", "--duration-s", min=1, help="Length in s, instead of the project's."
        ),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="PNG or SVG of the standard errors over the plane.")
    ] = None,
    compare: Annotated[bool, typer.Option(help="Also choose D-optimally, for comparison.")] = True,
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
) -> None:
    """Design a motion within the machine's limits, and say what it will tell before it runs.

    The limits stand in the section `excite` of the project file: stroke_mm, speed_mps, command_v,
    pressure_mpa, usual_supply_mpa, mass_kg, kp_per_s and volts_per_mps are needed; duration_s,
    command_rate_per_s, offset_v, supply_mpa, supply_pa_per_s, tank_mpa, may_shut, see, load_n,
    load_slope_n_per_m, friction_n, friction_ns_per_m, deadband_v and blend_mps have defaults;
    stops_mm: stops that the piston may be held against, for `--see pressure_sensor_bias`.

    The motion is a row of segments from rest to rest, chosen for what they tell per second on the
    nominal machine (the data sheet's or the learned maps).  Predicted are the standard error of
    every block and of beta, and the smallest size of each effect that would be seen, beside the
    paper's swept sine and a D-optimal choice from the same segments.
    """
    from rtid.excite.exciting import as_json as plain
    from rtid.excite.exciting import excite as design
    from rtid.excite.exciting import write_csv
    from rtid.project import load
    from rtid.tell.excited import story
    from rtid.tell.replay import progress_bar
    from rtid.tell.terminal import make_console

    loaded, changes = load(project), {} if duration_s is None else {"duration_s": duration_s}
    with progress_bar() as progress:
        excited = design(loaded, see or [], after, compare, progress, **changes)
    if out is not None:
        write_csv(out, excited.design)
    if picture is not None:
        from rtid.tell.charts.excited import predicted

        predicted(excited.design.machine.model, excited.predictions).savefig(picture, dpi=150)
    if as_json:
        print(json.dumps(plain(excited) | {"written": str(out) if out else None}))
    else:
        make_console().print(story(excited, see or []))
        if out is not None:
            print(f"wrote {out}")
