"""The prior map of a project: an older map, another machine's, its type's, or a data sheet.

It fills what the data do not tell, with the status `prior` and an honest deviation; see
`rtid.estimator.prior` for how it is believed, and for what it is believed where data contradict it.

    [prior]
    map = "last_year.npz"    # of `rtid export` or `rtid fleet`, a data sheet, a folder of `fleet`
    error_percent = 10       # how well its flows are believed; 1 for a typical map
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rtid.compare.reference import Flow, theta_cells
from rtid.errors import RtidError, door
from rtid.estimator.cells import quadrature, terms
from rtid.estimator.flowmap import PRIOR, EdgeMap, FlowMap
from rtid.estimator.prior import SHARE, Prior, reference_map
from rtid.estimator.published import publish
from rtid.estimator.solution import Solution
from rtid.maps.datasheet import read_reference
from rtid.maps.files import MAP_FILES, read_map
from rtid.model import Edge, Machine
from rtid.project import Project
from rtid.project.schema import PriorSection

SHARE_OF_TYPICAL = 0.01  # its spread over the machines comes with it
SAME_UNIT = 5.0  # ratio of two machines' largest commands, pressure drops ...
SAME_FLOW = 30.0  # ... and flows, beyond which one of them is in another unit


class PriorError(RtidError):
    """A prior map that does not fit the machine; the text names file, edge and quantity."""


def with_prior(project: Project, path: Path | None) -> Project:
    """The project with another prior map, where one is given."""
    if path is None:
        return project
    section = project.sections.prior or PriorSection(map="")
    section = section.model_copy(update={"map": str(path.absolute())})
    return replace(project, sections=replace(project.sections, prior=section))


@door
def find_prior(project: Project) -> Prior | None:
    """The prior of the project file.  Raises PriorError, MapFileError, DataSheetError, OSError."""
    section = project.sections.prior
    if section is None:
        return None
    path, share = _file(project.path.parent / section.map, project.machine_digest), SHARE
    if path.suffix.lower() in MAP_FILES:
        flowmap, origin = read_map(path)
        share = SHARE_OF_TYPICAL if "machines" in origin else SHARE
    else:
        flowmap = of_flow(project.model, read_reference(path).flow)
    _refuse_foreign(path, project.model, flowmap)
    given = section.error_percent
    return Prior(path.stem, flowmap, share if given is None else given / 100)


@door
def published(solution: Solution, prior: Prior | None) -> FlowMap:
    """The map of all edges; what data do not tell is the prior's."""
    return publish(solution) if prior is None else publish(solution, prior.flowmap, prior.share)


def said_of(prior: Prior, flowmap: FlowMap) -> str:
    """What of a published map is the prior's."""
    filled = [int((edge.status == PRIOR).sum()) for edge in flowmap.edges]
    has = {edge.name for edge in prior.flowmap.edges}
    cells = ", ".join(f"{e.name} {n}" for e, n in zip(flowmap.edges, filled, strict=True))
    without = [edge.name for edge in flowmap.edges if edge.name not in has]
    more = f"; it has no map for {', '.join(without)}" if without else ""
    return f"Prior map {prior.name}: blocks that are its own: {cells}{more}."


def of_flow(model: Machine, flow: Flow) -> FlowMap:
    """A known flow(edge, w, dp) as a prior map; what six terms miss of it is its own deviation."""
    flowmap = reference_map(model, theta_cells(model, flow))
    for edge in flowmap.edges:
        for i, column in enumerate(edge.theta):
            missed = flow(edge.name, *quadrature(edge.grid, i)) - column @ terms().T
            edge.cov[i, :, 0, 0] = np.mean(missed**2, axis=1)
    return flowmap


def _file(path: Path, digest: str) -> Path:
    """The file itself, or in a folder of `rtid fleet` the typical map of this declaration."""
    if not path.is_dir():
        return path
    file = path / f"typical-{digest[:8]}.npz"
    if file.is_file():
        return file
    there = ", ".join(sorted(p.name for p in path.glob("typical-*.npz"))) or "none"
    raise PriorError(
        f"{path}: no typical map of this machine's declaration ({file.name}), only {there}",
        "`rtid fleet` makes one of three machines or more with this project file; or name a file",
    )


def _refuse_foreign(path: Path, model: Machine, flowmap: FlowMap) -> None:
    edges = {edge.name: edge for edge in model.maps}
    foreign = [edge.name for edge in flowmap.edges if edge.name not in edges]
    if foreign:
        raise PriorError(
            f"{path}: a map for {', '.join(foreign)}, which this machine does not have",
            f"name its edges as the project does: {', '.join(edges)}",
        )
    for prior in flowmap.edges:
        _refuse_unit(path, edges[prior.name], prior)


def _refuse_unit(path: Path, edge: Edge, prior: EdgeMap) -> None:
    """Ranges and flows that differ by so much are no other machine but another unit."""
    pairs = {
        "command": (np.abs(prior.grid.u_v).max(), np.abs(edge.grid.u_v).max(), SAME_UNIT, "V"),
        "pressure drop": (
            np.abs(prior.grid.dp_pa).max(), np.abs(edge.grid.dp_pa).max(), SAME_UNIT, "Pa",
        ),
        "flow": (_flow_at_rated_dp(edge, prior), edge.rated_q_m3s, SAME_FLOW, "m3/s"),
    }  # fmt: skip
    for quantity, (theirs, ours, most, unit) in pairs.items():
        if np.isfinite(theirs) and not 1 / most <= theirs / ours <= most:
            raise PriorError(
                f"{path}: edge {edge.name}, largest {quantity} {theirs:.3g} {unit} where this "
                f"machine has {ours:.3g}",
                "the units do not match: name them in the header of a CSV, or export the map with "
                "a project whose command is in the same unit",
            )


def _flow_at_rated_dp(edge: Edge, prior: EdgeMap) -> float:
    """The prior's largest flow, brought to the rated pressure drop by the orifice law."""
    dp = 0.5 * (prior.grid.dp_pa[1:] + prior.grid.dp_pa[:-1])
    dp = dp[np.abs(dp) > 0.01 * edge.rated_dp_pa]
    w = 0.5 * (prior.grid.u_v[1:] + prior.grid.u_v[:-1])
    flow = np.abs(prior.flow(w[:, None], dp)) * np.sqrt(edge.rated_dp_pa / np.abs(dp))
    known = flow[np.isfinite(flow)]
    return float(known.max()) if known.size else float("nan")
