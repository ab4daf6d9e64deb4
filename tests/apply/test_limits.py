"""Limits of any map, a first one too: its size, its table, its distance from the prior."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.cli.exits import Exit
from rtid.estimator.flowmap import FlowMap
from rtid.maps.files import write_map
from rtid.project import Project, load
from tests.apply.neighbour import learned, offer, project_file
from tests.command import said


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> tuple[Project, FlowMap]:
    project = load(project_file(tmp_path_factory.mktemp("project")))
    return project, learned(project, 0)


def times(flow_map: FlowMap, factor: float) -> FlowMap:
    edges = tuple(replace(e, theta=factor * e.theta) for e in flow_map.edges)
    return replace(flow_map, edges=edges)


def one_cell(flow_map: FlowMap, flow_m3s: float) -> FlowMap:
    """The same with another flow in one block of the second edge."""
    first, second, *others = flow_map.edges
    theta = second.theta.copy()
    theta[5, 5] = 0.0
    theta[5, 5, 0] = flow_m3s
    return replace(flow_map, edges=(first, replace(second, theta=theta), *others))


def dry_run(folder: Path, flow_map: FlowMap, **keys: object) -> list[str]:
    """The objections of `rtid apply --dry-run` to a first map."""
    path = project_file(folder, error_percent=5, **keys)
    offer(folder / "cylinder.state", load(path), flow_map)
    code, out, _ = said("apply", path, "--dry-run", "--json")
    told = json.loads(out)
    assert code == Exit.OK and told["applied"] is None
    assert all({"u_v", "dp_pa"} == set(e["error_at"]) for e in told["lookup"].values())
    return list(told["objections"])


def test_a_healthy_first_map_is_not_objected_to(
    machine: tuple[Project, FlowMap], tmp_path: Path
) -> None:
    assert dry_run(tmp_path, machine[1], max_error_percent=6) == []


def test_a_map_thirty_times_too_large_is_refused_with_the_place(
    machine: tuple[Project, FlowMap], tmp_path: Path
) -> None:
    against = dry_run(tmp_path, times(machine[1], 30.0))
    of_size = [text for text in against if "max_flow_percent is 500" in text]
    assert {text.split(":")[0] for text in of_size} == {"pa", "at", "pb", "bt"}
    assert all(" V, dp = " in text and "times what a valve" in text for text in of_size)


@pytest.mark.parametrize("flow_m3s", [1e3, -1e3])
def test_one_absurd_cell_is_refused_and_so_is_what_it_does_to_the_others(
    machine: tuple[Project, FlowMap], tmp_path: Path, flow_m3s: float
) -> None:
    """With 16 bits for 1,000 m3/s all other flows of the edge become 0."""
    against = dry_run(tmp_path, one_cell(machine[1], flow_m3s))
    size, table = (
        next(t for t in against if key in t) for key in ("max_flow_percent", "max_error_percent")
    )
    edge = machine[0].model.edges[1]
    border = edge.direction * edge.grid.u_v[5:7]
    at_v = float(size.split(" at ")[1].split(" V")[0])
    assert size.startswith("at: ") and min(border) - 1e-2 <= at_v <= max(border) + 1e-2
    assert table.startswith("at: ") and "one step of its 16 bits is" in table
    assert not any(text.startswith("pa: ") and "max_flow" in text for text in against)


def test_a_map_on_data_far_from_the_prior_is_refused(
    machine: tuple[Project, FlowMap], tmp_path: Path
) -> None:
    flow_map = machine[1]
    beta = {"beta_pa": [8e8, 8e8], "beta_sd_pa": [1e6, 1e6]}
    write_map(tmp_path / "before.npz", flow_map, beta)

    def objections(factor: float, **keys: object) -> list[str]:
        path = project_file(tmp_path, error_percent=5, max_error_percent=50, **keys)
        path.write_text(path.read_text() + '\n[prior]\nmap = "before.npz"\n')
        offer(tmp_path / "cylinder.state", load(path), times(flow_map, factor))
        return list(json.loads(said("apply", path, "--dry-run", "--json")[1])["objections"])

    assert objections(1.2) == []
    far = objections(6.0, max_flow_percent=1e6)
    assert far and all("from the prior's at" in text for text in far)


def test_how_near_healthy_maps_come_to_the_limit(machine: tuple[Project, FlowMap]) -> None:
    """A map that is right is not near: the limit of 500 % is for what cannot be."""
    project, flow_map = machine
    for edge in project.model.edges:
        grid = edge.grid
        w, dp = np.meshgrid(grid.u_v[1:], grid.dp_pa[:-1], indexing="ij")
        lawful = edge.rated_q_m3s * np.sqrt(np.maximum(np.abs(dp), edge.rated_dp_pa))
        share = np.abs(flow_map[edge.name].flow(w, dp)) * np.sqrt(edge.rated_dp_pa) / lawful
        assert np.nanmax(share) < 2.5
