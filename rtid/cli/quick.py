"""`rtid quick FILE`: without a project file; is this data good enough, and what is missing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from rtid.cli.exits import Exit, refuse_truncated
from rtid.cli.options import AsJson, Replace, RoleOption, UnitsOption, by_role
from rtid.errors import RtidError
from rtid.units import System

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rtid.study.quick import Quick
    from rtid.study.quick_machine import Given
    from rtid.study.quick_plant import QuickPlant
    from rtid.study.quick_rate import QuickRate


def _volumes(text: str | None) -> str | None:
    """One volume, or those of a and b."""
    try:
        if text is not None and min(_both(text)) <= 0.0:
            raise ValueError
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not one or two volumes, 0.6 or 0.6,0.5") from None
    return text


def _both(text: str) -> tuple[float, float]:
    """Volumes of a and b, m3."""
    a, b = (float(word) for word in (text.split(",") if "," in text else (text, text)))
    return 1e-3 * a, 1e-3 * b


Files = Annotated[
    list[Path],
    typer.Argument(help="Table (.csv .parquet .mat) or CAN log; of several, one project."),
]
Dbc = Annotated[Path | None, typer.Option(help="DBC of a CAN log; the built-in one without it.")]
BoreMm = Annotated[float | None, typer.Option("--bore", min=1.0, help="Piston diameter, mm.")]
RodMm = Annotated[float | None, typer.Option("--rod", min=0.0, help="Rod, mm.")]
StrokeMm = Annotated[float | None, typer.Option("--stroke", min=1.0, help="Stroke, mm.")]
DeadVolumeL = Annotated[
    str | None,
    typer.Option(
        "--dead-volume",
        callback=_volumes,
        help="Volume left at the ends, with hoses, L: one, or A,B.",
    ),
]
SafeBand = Annotated[
    float | None,
    typer.Option(
        help="Command up to which the valves are shut for sure, in the unit of its column; "
        "below 0 where they stand open at rest.",
    ),
]
LagMs = Annotated[
    float | None, typer.Option("--lag", min=0.0, help="Lag of the spools, data sheet, ms.")
]
SupplyMpa = Annotated[
    float | None,
    typer.Option("--supply", min=0.01, help="Supply pressure, MPa, where it is not measured."),
]
HeldOut = Annotated[
    list[str] | None,
    typer.Option("--held-out", help="Name or pattern of records that judge; else the last."),
]
Save = Annotated[
    Path | None,
    typer.Option("--save", "-o", "--output", help="Write the project file of what was found."),
]


def quick(
    files: Files,
    dbc: Dbc = None,
    bore_mm: BoreMm = None,
    rod_mm: RodMm = None,
    stroke_mm: StrokeMm = None,
    dead_volume_l: DeadVolumeL = None,
    safe_band: SafeBand = None,
    lag_ms: LagMs = None,
    supply_mpa: SupplyMpa = None,
    role: RoleOption = None,
    held_out: HeldOut = None,
    save: Save = None,
    force: Replace = False,
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
) -> None:
    """Say within a minute whether this data is good enough, and which effect is missing.

    Guesses the roles of the signals by name, unit and range, takes the grids from the data, and
    states what it assumes of the machine; --save writes the project of it, with which every other
    command gives the same answer.  A table without pressures is one of a plant whose rate follows a
    command: its neutral, dead band, gains and delay are found; one that empties or cools down by
    itself is refitted by its equations, as `rtid refit` does.  Exit code 3: the file cannot be
    read, or is of no kind of plant; 4: it is read, and too little for a verdict.
    """
    from rtid.study.quick import quick as look
    from rtid.tell.replay import progress_bar

    if save is not None and save.exists() and not force:
        raise RtidError(f"{save} exists", "give another --save, or --force", Exit.USAGE)
    given = _given(bore_mm, rod_mm, stroke_mm, dead_volume_l, safe_band, lag_ms, supply_mpa)
    file, *more = files
    with progress_bar() as progress:
        looked = look(file, dbc, given, progress, by_role(role or []), more, held_out or ())
    answer = _answer(looked, file, save)
    if save is not None:
        save.write_text(answer.project, "utf-8")
    print(json.dumps(answer.document) if as_json else "\n".join(answer.lines))
    refuse_truncated(file, {"truncated": int(answer.is_truncated)})
    if not looked.is_enough:
        raise typer.Exit(Exit.NEGATIVE)


def _given(
    bore_mm: float | None,
    rod_mm: float | None,
    stroke_mm: float | None,
    dead_volume_l: str | None,
    safe_band: float | None,
    lag_ms: float | None,
    supply_mpa: float | None,
) -> Given:
    """What the user says of the machine, in SI."""
    from rtid.study.quick_machine import Given

    if bore_mm is not None and rod_mm is not None and rod_mm >= bore_mm:
        raise RtidError("--rod is not thinner than --bore", "give diameters in mm", Exit.USAGE)
    bore_m, rod_m, stroke_m, lag_s = (
        None if value is None else 1e-3 * value for value in (bore_mm, rod_mm, stroke_mm, lag_ms)
    )
    volumes_m3 = _both(dead_volume_l) if dead_volume_l else None
    supply_pa = None if supply_mpa is None else 1e6 * supply_mpa
    return Given(bore_m, rod_m, stroke_m, volumes_m3, safe_band, lag_s, supply_pa)


class _Answer(NamedTuple):
    """What is said of a file, in words and as JSON, and the text of its project."""

    project: str
    lines: Iterable[str]
    document: dict[str, Any]
    is_truncated: bool


def _answer(looked: Quick | QuickRate | QuickPlant, file: Path, save: Path | None) -> _Answer:
    from rtid.study.quick_plant import QuickPlant
    from rtid.study.quick_rate import QuickRate
    from rtid.tell.quick import lines, rate_lines
    from rtid.tell.quick_equations import plant_json, plant_lines

    if isinstance(looked, QuickPlant):
        return _Answer(
            looked.found.text, plant_lines(looked, save), plant_json(looked, save), False
        )
    if isinstance(looked, QuickRate):
        return _Answer(
            looked.text_for(save or file), rate_lines(looked, save), looked.as_json(), False
        )
    text, document = looked.text_for(save or file), looked.as_json(save)
    return _Answer(text, lines(looked, save), document, looked.truncated)
