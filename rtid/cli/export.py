"""`rtid export`: write the learned maps for a controller, a spreadsheet or another program."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from rtid.cli.options import AsJson, NoCache, PriorOption, ProjectOption

if TYPE_CHECKING:
    from rtid.estimator.flowmap import FlowMap
    from rtid.estimator.prior import Prior
    from rtid.estimator.solution import Solution
    from rtid.estimator.validity import Doubt
    from rtid.maps.flashed import FlashedDifference, FlashedMap
    from rtid.maps.gridded import Gridded, Tables
    from rtid.maps.release import Room
    from rtid.project import Project
    from rtid.study.study import Study

SNAPSHOT = ".npz"
RECORDED = (".mf4", ".mcap")


def _nodes(text: str | None) -> str | None:
    """Two numbers with an x between them."""
    if text is not None and (re.fullmatch(r"\d+x\d+", text) is None or min(_pair(text) or ()) < 2):
        raise typer.BadParameter(f"{text!r} is no COMMANDSxDROPS, 16x12, of 2 or more each")
    return text


def _pair(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    commands, drops = text.split("x")
    return int(commands), int(drops)


Source = Annotated[Path, typer.Argument(help="Snapshot (.npz) of `rtid replay`, or a trace.")]
Output = Annotated[
    Path,
    typer.Argument(
        help="File: .csv .json .npz .mat .m .dcm .cdfx .a2l .mo .st .h .fmu .mf4 .mcap."
    ),
]
Force = Annotated[
    bool, typer.Option("--force", help="Write it even if what was learned is impossible.")
]
Fmi = Annotated[int, typer.Option("--fmi", help="Version of FMI of an FMU: 2 or 3.")]
MapAlone = Annotated[
    bool, typer.Option("--map", help="An FMU of the maps alone: pressures are its inputs.")
]
Tolerance = Annotated[
    float | None,
    typer.Option(
        min=0.01,
        max=50.0,
        help="Per cent of the largest flow that a table may miss the map by (0.2).",
    ),
]
Nodes = Annotated[
    str | None,
    typer.Option(callback=_nodes, help="Most nodes of a table, commands x drops: 16x12."),
]
NBytes = Annotated[
    int | None,
    typer.Option("--bytes", min=64, help="Most bytes of all tables, as 16-bit numbers."),
]
Axes = Annotated[
    Path | None, typer.Option(help="Take the axes of these maps: .dcm, .cdfx or .csv.")
]
Flashed = Annotated[
    Path | None, typer.Option(help="Tell the difference to these maps; --axes does it too.")
]
Sheet = Annotated[
    Path | None, typer.Option(help="Write a sheet to be signed (.html) of what is released.")
]


def export(
    source: Source,
    output: Output,
    project: ProjectOption,
    prior_map: PriorOption = None,
    force: Force = False,
    fmi: Fmi = 2,
    map_alone: MapAlone = False,
    tolerance: Tolerance = None,
    nodes: Nodes = None,
    n_bytes: NBytes = None,
    axes: Axes = None,
    flashed: Flashed = None,
    sheet: Sheet = None,
    as_json: AsJson = False,
    no_cache: NoCache = False,
) -> None:
    """Write the learned maps: flow, standard deviation and status over command and pressure drop.

    CSV is a long table at the nodes and centres of the grid; JSON and npz hold everything; .mat, .m
    (Simulink.LookupTable), .dcm, .cdfx and .a2l (calibration tools), .mo and .st hold the smallest
    grids on which straight lines miss no more than 0.2 % of the largest flow, with deviation and
    status: --tolerance, --nodes, --bytes or --axes say otherwise; a C99 header holds
    look-up tables, float and fixed point, with their functions beside it; an FMU (co-simulation by
    FMI 2.0 or 3.0) holds the machine with its effects, bulk moduli and lag; packages bring more.
    A map of acceleration over pedal and speed is written as accel_map.csv, with brake_map.csv
    beside it, for Autoware.
    .mf4 and .mcap hold the record: signals, residual, block and status over time, estimates.
    From a trace the maps are learned beside the effects that `rtid add` has added, whose flow is
    not in them; a snapshot holds the maps as they were learned, on board beside those that can run
    live.  Exit code 4: what was learned is impossible, or no block stands on data (but in .json,
    .npz and .csv), and nothing is written without --force.
    """
    from rtid.maps.files import provenance
    from rtid.maps.flashed import differences
    from rtid.maps.fmu import check_version
    from rtid.maps.prior_map import with_prior
    from rtid.maps.release import refuse_unfounded
    from rtid.plain import plain
    from rtid.project import load
    from rtid.tell.released import sheet as sheet_of

    room, there = _room(tolerance, nodes, n_bytes, axes, flashed)
    _refuse_format(output, room.is_asked or sheet is not None)
    check_version(fmi)
    loaded = with_prior(load(project), prior_map)
    learned = _learned(loaded, source)
    if not force:
        what = str(source), output.suffix, learned.invalid, learned.flowmap
        refuse_unfounded(*what, has_prior=learned.prior is not None)
    identity = loaded.name, loaded.digest, source.name, learned.effects
    origin = provenance(learned.solution, *identity)
    tables = _written(output, loaded, learned, origin, room, fmi, map_alone)
    changes = differences(learned.flowmap, there) if there else []
    if sheet is not None:
        sheet.write_text(sheet_of(output.name, tables, changes, origin), "utf-8")
    if as_json:
        facts = {"tables": [_facts(table) for table in tables], "changed": plain(changes)}
        document = {"schema": 1, "written": str(output), "valid_blocks": learned.cells}
        print(json.dumps(document | {"effects": learned.effects} | facts))
    else:
        _print(output, loaded, learned, tables, changes)


def _room(
    tolerance: float | None,
    nodes: str | None,
    n_bytes: int | None,
    axes: Path | None,
    flashed: Path | None,
) -> tuple[Room, tuple[FlashedMap, ...]]:
    """How large tables may be, and the maps that are there already."""
    from rtid.maps.flashed import read_flashed
    from rtid.maps.release import Room

    file = axes or flashed
    there = read_flashed(file) if file else ()
    share = 0.01 * tolerance if tolerance else None
    return Room(share, _pair(nodes), n_bytes, there if axes else ()), there


def _print(
    output: Path,
    project: Project,
    learned: Exported,
    tables: Tables,
    changes: list[FlashedDifference],
) -> None:
    from rtid.maps.prior_map import said_of
    from rtid.tell.released import said

    text = ", ".join(f"{name} {count}" for name, count in learned.cells.items())
    print(f"wrote {output}; valid blocks: {text}")
    for line in said(tables, changes):
        print(line)
    print(_beside(learned.effects, project))
    if learned.prior is not None:
        print(said_of(learned.prior, learned.flowmap))


def _refuse_format(output: Path, is_sized: bool) -> None:
    """RtidError for a suffix that is none, or that holds no table whose size can be asked for."""
    from rtid.errors import RtidError
    from rtid.maps.c_header import SUFFIX
    from rtid.maps.files import formats
    from rtid.maps.fmu import SUFFIX as FMU
    from rtid.maps.release import refuse_sized

    suffix, known = output.suffix.lower(), (*formats(), SUFFIX, FMU, *RECORDED)
    if suffix not in known:
        remedy = f"end its name in {', '.join(known)}"
        raise RtidError(f"{output}: unknown format", remedy, exit_code=2)
    if is_sized:
        refuse_sized(output)


def _written(
    output: Path,
    project: Project,
    learned: Exported,
    origin: dict[str, Any],
    room: Room,
    fmi: int,
    map_alone: bool,
) -> Tables:
    """Write the file; the tables in it, none where its format has no plain ones."""
    from rtid.errors import RtidError
    from rtid.maps.c_header import SUFFIX, write_header
    from rtid.maps.fmu import SUFFIX as FMU
    from rtid.maps.release import write_release

    suffix = output.suffix.lower()
    if suffix == SUFFIX:
        percent = project.sections.publish.error_percent
        write_header(output, project.model, learned.flowmap, origin, percent)
    elif suffix == FMU:
        _write_fmu(output, learned, origin, fmi, map_alone)
    elif suffix in RECORDED:
        from rtid.tell.recorded import write_recorded

        if learned.study is None:
            raise RtidError("a snapshot holds no record over time", "export from a trace")
        write_recorded(output, learned.study, origin)
    else:
        return write_release(output, learned.flowmap, origin, room)
    return ()


def _facts(table: Gridded) -> dict[str, Any]:
    shape = {"nodes": list(table.flow_m3s.shape), "bytes": table.n_bytes}
    return {"map": table.name, **shape, "off_by": table.miss}


def _beside(effects: list[dict[str, Any]], project: Project) -> str:
    """Beside which effects the maps were learned, and which they had to take up."""
    if effects:
        names = ", ".join(f"{e['effect']} at {e['where']}" for e in effects)
        return f"Learned beside {names}: their flow is not in the maps."
    added = [f"{a.effect} at {a.where}" for a in project.sections.added]
    if added:
        return (
            f"This snapshot was learned without {', '.join(added)}, which the project has added: "
            "the maps hold what they could of it.  Export from a trace to have it apart."
        )
    return "The project has added no effects."


class Exported(NamedTuple):
    """What is exported; lag_s: of the spools; timings: effects that act on times of signals.

    study: of the trace; None of a snapshot.
    """

    solution: Solution
    flowmap: FlowMap
    effects: list[dict[str, Any]]
    invalid: list[Doubt]
    lag_s: float
    timings: list[str]
    prior: Prior | None
    study: Study | None = None

    @property
    def cells(self) -> dict[str, int]:
        """Valid blocks by edge."""
        return {e.name: int((e.status == "valid").sum()) for e in self.flowmap.edges}


def _write_fmu(
    output: Path, learned: Exported, origin: dict[str, Any], version: int, map_alone: bool
) -> None:
    from rtid.maps.fmu import Dynamics, NoFmuError, write_fmu

    solution = learned.solution
    if learned.timings and not map_alone:
        names = ", ".join(learned.timings)
        raise NoFmuError(f"{names}: an effect on times of signals", "--map exports the map alone")
    dynamics = Dynamics(solution.compliance, solution.terms_theta, learned.lag_s)
    given = None if map_alone else dynamics
    if not write_fmu(output, solution.model, learned.flowmap, given, origin, version):
        print("There is no C compiler here: it has sources alone, and no binary.", file=sys.stderr)


def _learned(project: Project, source: Path) -> Exported:
    """From a snapshot as it is, from a trace by the record path; effects beside, what is wrong."""
    from rtid.estimator.validity import doubts_of
    from rtid.maps.prior_map import find_prior, published

    timings, study, prior = list[str](), None, find_prior(project)
    if source.suffix.lower() == SNAPSHOT:
        from rtid.study.on_board import load_for

        estimator, live = load_for(source, project)
        solution, lag = estimator.solution(), (0.0, 0.0)
        flowmap = published(solution, prior)
        effects = [{"effect": a.effect, "where": a.where} for a in live]
        lag_s = solution.model.lag.nominal_s
    else:
        from rtid.study.known_effects import as_json
        from rtid.study.study import Study
        from rtid.tell.replay import progress_bar

        with progress_bar() as progress:
            study = Study(project, source, progress)
            fit, flowmap = study.fit, study.map
            timings = study.timings
        solution, lag = fit.solution, (fit.lag_s, fit.lag_sd_s)
        effects, lag_s = as_json(study.effects), fit.lag_s
    invalid = [doubt for doubt in doubts_of(solution, *lag) if doubt.is_invalid]
    return Exported(solution, flowmap, effects, invalid, lag_s, timings, prior, study)
