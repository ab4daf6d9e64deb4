"""What a prior map of the project is worth before a motion, and beside what is learned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtid.estimator.estimator import Estimator
from rtid.estimator.flowmap import FlowMap
from rtid.excite import library
from rtid.excite.excitable import machine_of, section_of, start
from rtid.excite.exciting import NothingMissingError, excite
from rtid.excite.information import PRIOR
from rtid.excite.known import known_from, prior_cells, take_prior
from rtid.excite.selection import D_OPTIMAL, ENOUGH_ROWS, KnownCells, standard_errors
from rtid.maps.files import write_map
from rtid.maps.prior_map import find_prior, of_flow
from rtid.plain import FloatArray
from rtid.project import Project, load
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import EDGES, SimulatedPlant, flow_points
from rtid.trace.snapshot import save
from tests.excite.machines import machine, write_project

NUMBER = 7


def true_map(project: Project, plant: SimulatedPlant, scale: float = 1.0) -> FlowMap:
    """What the valves do, all gains off by a factor."""

    def flow(edge: str, w_v: FloatArray, dp_pa: FloatArray) -> FloatArray:
        w, dp = np.broadcast_arrays(w_v, dp_pa)
        q = np.empty(w.size)
        table = plant.valve_table()[EDGES.index(edge)]
        flow_points(table, w.ravel().copy(), dp.ravel().copy(), plant.constants.dp_laminar_pa, q)
        return scale * q.reshape(w.shape)

    return of_flow(project.model, flow)


def with_map(folder: Path, scale: float, error_percent: float, *edges: str) -> Project:
    """The owner's project with a prior map, of some edges or of all."""
    plant = machine(NUMBER)
    path = write_project(folder, plant, NUMBER)
    known = true_map(load(path), plant, scale)
    kept = tuple(e for e in known.edges if not edges or e.name in edges)
    write_map(folder / "before.npz", FlowMap(kept), {})
    more = f'\n[prior]\nmap = "before.npz"\nerror_percent = {error_percent}\n'
    path.write_text(path.read_text("utf-8") + more, "utf-8")
    return load(path)


def known_before(project: Project) -> KnownCells:
    prior, known = find_prior(project), KnownCells.nothing(project.model.n_cells)
    assert prior is not None
    take_prior(known, project.model, prior)
    return known


def test_a_prior_is_known_to_its_share_and_tells_nothing_of_other_edges(tmp_path: Path) -> None:
    project = with_map(tmp_path, 1.0, 10.0, "pa")
    known, model = known_before(project), project.model
    edge, n = model.edges[0], int(np.prod(model.edges[0].grid.shape))
    assert (known.rows[:n] >= ENOUGH_ROWS).all() and not known.rows[n:].any()
    assert not known.blocks[n:].any()
    prior = find_prior(project)
    assert prior is not None
    flow = np.abs(prior_cells(model, prior)[0][:n, 0]) / edge.rated_q_m3s
    large = flow > 0.5 * flow.max()
    shares = standard_errors(known.blocks[:n])[large] / flow[large]
    assert 0.09 < np.median(shares) < 0.12  # 10 %, and what six terms miss


def test_the_nominal_machine_has_the_priors_map_where_nothing_is_learned(tmp_path: Path) -> None:
    project = with_map(tmp_path, 1.0, 10.0, "pa")
    plain, prior = (machine_of(project, section_of(project)), find_prior(project))
    found = machine_of(project, section_of(project), None, prior)
    n = int(np.prod(project.model.edges[0].grid.shape))
    truth = true_map(project, machine(NUMBER)).theta_cells()
    np.testing.assert_allclose(found.theta[:n, 0], truth[:n, 0], atol=2e-2 * truth[:n, 0].max())
    assert np.array_equal(found.theta[n:], plain.theta[n:])


def test_a_prior_that_the_record_contradicts_is_believed_less(tmp_path: Path) -> None:
    """Off by 20 % and said to be good to 1 %."""
    project = with_map(tmp_path, 0.8, 1.0)
    prior, model = find_prior(project), project.model
    assert prior is not None
    estimator = Estimator(model)
    estimator.update(simulate(machine(NUMBER), "rich", 1, 10.0).samples)
    solution = estimator.solution()
    learned = known_from(model, solution)
    trusting, wary = learned.copy(), learned.copy()
    take_prior(trusting, model, prior)
    take_prior(wary, model, prior, solution.blocks)
    empty = learned.rows == 0
    shares = standard_errors(wary.blocks[empty]) / standard_errors(trusting.blocks[empty])
    assert np.median(shares) > 5.0
    own = learned.rows > 0
    errors = (standard_errors(k.blocks[own]) for k in (wary, learned))
    wary_sd, learned_sd = errors
    assert (wary_sd <= learned_sd * (1 + 1e-9)).all()
    assert np.linalg.eigvalsh(wary.blocks + PRIOR).min() > 0


@pytest.fixture
def few_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "PACES", (0.3, 0.5))
    monkeypatch.setattr(library, "SWINGS", ((0.65, 1.0),))
    monkeypatch.setattr(library, "STEPS", ((0.5, 0.07),))
    monkeypatch.setattr(library, "PASS_STEPS", ((0.5, 0.07),))
    monkeypatch.setattr(library, "ZIGZAGS", (0.3,))


@pytest.mark.long
@pytest.mark.usefixtures("few_segments")
def test_a_segment_tells_less_where_a_prior_knows(tmp_path: Path) -> None:
    """By the determinant; the map's error may fall more where a prior adds what is lacking."""
    project = with_map(tmp_path, 1.0, 10.0, "pa", "at")
    begun, model = start(project), project.model
    assert begun.known is not None and begun.taught_by == "the prior before"
    weights, nothing = np.ones(model.n_cells), KnownCells.nothing(model.n_cells)
    for c in begun.pool:
        alone = nothing.gain(c.told, D_OPTIMAL, weights)
        assert begun.known.gain(c.told, D_OPTIMAL, weights) < 0.95 * alone
    learned, snapshot = Estimator(model), tmp_path / "state.npz"
    learned.update(simulate(machine(NUMBER), "rich", 1, 4.0).samples)
    save(snapshot, learned, project.digest)
    after = start(project, after=snapshot)
    assert after.taught_by == f"{snapshot} and the prior before"
    assert after.known is not None
    more = after.known.blocks - known_from(model, learned.solution()).blocks
    priors = np.isin(np.arange(model.n_cells), np.flatnonzero(begun.known.rows))
    assert np.array_equal(more.any(axis=(1, 2)), priors)


@pytest.mark.long
@pytest.mark.usefixtures("few_segments")
def test_where_all_is_known_no_motion_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtid.estimator.prior.LEAST_SIZE", 1e-6)  # no dead band ends elsewhere
    monkeypatch.setattr("rtid.excite.design.GOAL", 0.05)  # beyond what six terms miss
    with pytest.raises(NothingMissingError, match="by the prior before, no segment"):
        excite(with_map(tmp_path, 1.0, 0.01))
