"""`rtid export`: write the learned maps for a controller, a spreadsheet or another program."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtid.cli.options import PriorOption, ProjectOption

if TYPE_CHECKING:
    from rtid.estimator.solution import Solution
    from rtid.project import Project

SNAPSHOT = ".npz"


def export(
    source: Annotated[Path, typer.Argument(help="Snapshot (.npz) of `rtid replay`, or a trace.")],
    output: Annotated[
        Path, typer.Argument(help="File to write: .csv .json .npz .mat .m .dcm .cdfx .h.")
    ],
    project: ProjectOption,
    prior_map: PriorOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")] = False,
) -> None:
    """Write the learned maps: flow, standard deviation and status over command and pressure drop.

    CSV is a long table at the nodes and centres of the grid; JSON and npz hold everything; .mat, .m
    (Simulink.LookupTable), .dcm and .cdfx (calibration tools) hold grids on which straight lines
    miss no more than 0.1 % of the largest flow, with deviation and status; a C99 header holds
    look-up tables, float and fixed point, with their functions beside it.  From a trace the maps
    are learned beside the effects that `rtid add` has added, whose flow is not in them; a snapshot
    holds the maps as they were learned, on board beside those that can run live.
    """
    from rtid.cfile import SUFFIX, write_header
    from rtid.errors import RtidError
    from rtid.mapfiles import FORMATS, provenance, write_map
    from rtid.priors import find_prior, published, said_of, with_prior
    from rtid.project import load

    if output.suffix.lower() not in (*FORMATS, SUFFIX):
        remedy = f"end its name in {', '.join((*FORMATS, SUFFIX))}"
        raise RtidError(f"{output}: unknown format", remedy, exit_code=2)
    loaded = with_prior(load(project), prior_map)
    prior = find_prior(loaded)
    solution, effects = _solution(loaded, source)
    flowmap = published(solution, prior)
    origin = provenance(solution, loaded.name, loaded.digest, source.name, effects)
    if output.suffix.lower() == SUFFIX:
        percent = loaded.sections.publish.error_percent
        write_header(output, loaded.model, flowmap, origin, percent)
    else:
        write_map(output, flowmap, origin)
    cells = {e.name: int((e.status == "valid").sum()) for e in flowmap.edges}
    if as_json:
        told = {"schema": 1, "written": str(output), "valid_blocks": cells, "effects": effects}
        print(json.dumps(told))
    else:
        text = ", ".join(f"{name} {count}" for name, count in cells.items())
        print(f"wrote {output}; valid blocks: {text}")
        print(_beside(effects, loaded))
        if prior is not None:
            print(said_of(prior, flowmap))


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


def _solution(project: Project, source: Path) -> tuple[Solution, list[dict[str, Any]]]:
    """From a snapshot as it is, from a trace by the record path; the effects beside it."""
    if source.suffix.lower() == SNAPSHOT:
        from rtid.daemon.beside import load_for

        estimator, live = load_for(source, project)
        return estimator.solution(), [{"effect": a.effect, "where": a.where} for a in live]
    from rtid.beside import as_json, replay_beside

    found = replay_beside(project, source)
    return found.fit.solution, as_json(found.added)
