"""A prior map for a machine: it fills what a short record leaves empty, and data overrule it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.daemon.analyst import Analyst
from rtid.daemon.jobs import Answer, Handover, Publication
from rtid.errors import RtidError
from rtid.estimator.flowmap import PRIOR, VALID, EdgeMap, FlowMap
from rtid.maps.files import read_map, write_map
from rtid.maps.prior_map import find_prior, of_flow, published, with_prior
from rtid.model import Grid
from rtid.plain import FloatArray
from rtid.project import Project, ProjectError, load
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import EDGES, SimulatedPlant, flow_points
from rtid.study.replay import Replay, replay
from tests.command import ends
from tests.replays import shared_replays  # noqa: F401

PLANT = SimulatedPlant()


def true_flow(edge: str, w_v: FloatArray, dp_pa: FloatArray) -> FloatArray:
    w, dp = np.broadcast_arrays(w_v, dp_pa)
    q = np.empty(w.size)
    valve = PLANT.valve_table()[EDGES.index(edge)]
    flow_points(valve, w.ravel().copy(), dp.ravel().copy(), PLANT.constants.dp_laminar_pa, q)
    return q.reshape(w.shape)


def true_map(project: Project, scale: float = 1.0) -> FlowMap:
    """What the valves do, all gains off by a factor."""
    return of_flow(project.model, lambda name, w, dp: scale * true_flow(name, w, dp))


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A machine, its record of 12 s, and as prior its own map, one off by 20 %, and bad ones."""
    folder = tmp_path_factory.mktemp("prior")
    write_run(folder / "run.parquet", simulate(PLANT, "rich", 1, 12.0), 1, "rich")
    loaded = load(folder / "run.toml")
    exact = true_map(loaded)
    write_map(folder / "exact.npz", exact, {})
    write_map(folder / "off.json", true_map(loaded, 0.8), {})
    other = replace(exact.edges[0], name="p_to_a")
    write_map(folder / "names.npz", FlowMap((other, *exact.edges[1:])), {})
    write_map(folder / "part.npz", FlowMap(exact.edges[:3]), {})
    write_map(folder / "ampere.npz", FlowMap(tuple(map(in_ampere, exact.edges))), {})
    lines = [f"{u},{dp},{60.0 * u * dp**0.5}" for u in (1, 5, 9) for dp in (1, 4)]
    (folder / "litres.csv").write_text("\n".join(["u_V,dp_MPa,Q_m3/s", *lines]))
    (folder / "fleet").mkdir()
    return loaded


def in_ampere(edge: EdgeMap) -> EdgeMap:
    return replace(edge, grid=Grid(0.08 * edge.grid.u_v, edge.grid.dp_pa))


@pytest.fixture(scope="module")
def replayed(project: Project) -> Replay:
    return replay(project, project.path.with_name("run.parquet"))


@pytest.fixture(scope="module")
def alone(replayed: Replay) -> FlowMap:
    """The map without a prior."""
    return published(replayed.fit.solution, None)


@pytest.fixture(scope="module")
def exact(project: Project, replayed: Replay) -> FlowMap:
    """The map with the machine's own as prior."""
    return filled(project, replayed, "exact.npz")


def filled(project: Project, replayed: Replay, file: str, share: float | None = None) -> FlowMap:
    """The map with a prior."""
    prior = find_prior(with_prior(project, project.path.with_name(file)))
    assert prior is not None
    return published(replayed.fit.solution, prior if share is None else replace(prior, share=share))


def centres(edge: EdgeMap, chosen: np.ndarray) -> tuple[FloatArray, FloatArray]:
    i, j = np.nonzero(chosen)
    u, dp = edge.grid.u_v, edge.grid.dp_pa
    return 0.5 * (u[i] + u[i + 1]), 0.5 * (dp[j] + dp[j + 1])


def misses(flowmap: FlowMap, status: str) -> tuple[FloatArray, FloatArray]:
    """Error at the centres of all blocks of a status, and its standard deviation."""
    errors, sds = [], []
    for edge in flowmap.edges:
        w, dp = centres(edge, edge.status == status)
        errors.append(edge.flow(w, dp) - true_flow(edge.name, w, dp))
        sds.append(edge.sd(w, dp))
    return np.concatenate(errors), np.concatenate(sds)


def test_data_overrule_a_wrong_prior_where_there_are_any(
    project: Project, replayed: Replay, alone: FlowMap
) -> None:
    """Valid blocks stay what they are without it, to a fiftieth of their standard deviation.

    Elsewhere a prior whose gains are off by 20 %, declared to 5 %, is believed less.
    """
    both = filled(project, replayed, "off.json", 0.05)
    valid = 0
    for before, after in zip(alone.edges, both.edges, strict=True):
        kept = before.status == VALID
        np.testing.assert_array_equal(after.status == VALID, kept)
        w, dp = centres(before, kept)
        change = np.abs(after.flow(w, dp) - before.flow(w, dp)) / before.sd(w, dp)
        assert np.quantile(change, 0.95) < 0.02
        valid += int(kept.sum())
    assert valid > 60
    error, sd = misses(both, PRIOR)
    assert len(error) > 100
    assert np.mean(np.abs(error) < 2 * sd) > 0.9


def test_a_good_prior_fills_what_was_not_visited(alone: FlowMap, exact: FlowMap) -> None:
    error, sd = misses(exact, PRIOR)
    assert len(error) > 250
    assert np.mean(np.abs(error) < 2 * sd) > 0.95
    assert not misses(alone, PRIOR)[0].size
    bare, there = [], []
    for before, after in zip(alone.edges, exact.edges, strict=True):
        w, dp = centres(after, after.status == PRIOR)
        bare.append(before.flow(w, dp) - true_flow(before.name, w, dp))
        there.append(after.flow(w, dp) - true_flow(after.name, w, dp))
    assert rms(there) < 0.5 * rms(bare)


def rms(parts: list[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("names.npz", "a map for p_to_a, which this machine does not have"),
        ("ampere.npz", "largest command 0.8 V where this machine has 10"),
        ("litres.csv", "largest flow"),
        ("fleet", "no typical map of this machine's declaration"),
    ],
)
def test_a_prior_that_does_not_fit_is_refused(project: Project, file: str, text: str) -> None:
    with pytest.raises(RtidError, match=text) as refused:
        find_prior(with_prior(project, project.path.with_name(file)))
    assert refused.value.remedy
    assert file in str(refused.value)


def test_the_project_file_names_the_prior(project: Project, tmp_path: Path) -> None:
    text = project.path.read_text()
    path = project.path.with_name("with_prior.toml")
    path.write_text(text + '\n[prior]\nmap = "part.npz"\nerror_percent = 4\n')
    prior = find_prior(load(path))
    assert prior is not None
    assert (prior.name, prior.share) == ("part", 0.04)
    assert load(path).digest == project.digest  # what was learned stays of use
    path.write_text(text + '\n[prior]\nmap = "none.npz"\n')
    with pytest.raises(ProjectError, match=r"prior\.map: no file 'none\.npz'"):
        load(path)


def test_export_takes_a_prior_and_says_what_it_fills(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    trace, out = (project.path.with_name(name) for name in ("run.parquet", "out.npz"))
    words = ["export", trace, out, "-p", project.path, "--prior", trace.with_name("part.npz")]
    assert ends(*words) == 0
    assert "Prior map part: blocks that are its own: pa " in (told := capsys.readouterr().out)
    assert "it has no map for bt" in told
    by_edge = {edge.name: (edge.status == PRIOR).sum() for edge in read_map(out)[0].edges}
    assert by_edge["pa"] > 50 and by_edge["bt"] == 0


def named(project: Project, prior: str) -> Project:
    """The same machine from a file that names a prior."""
    path = project.path.with_name(f"with_{prior}.toml")
    path.write_text(f'{project.path.read_text()}\n[prior]\nmap = "{prior}"\n')
    return load(path)


def test_on_board_the_map_that_is_published_has_the_prior(
    project: Project, replayed: Replay, tmp_path: Path
) -> None:
    answers: list[Answer] = []
    analyst = Analyst(named(project, "exact.npz"), tmp_path, answers.append)
    handed = replayed.live.copy()
    handed.history = None
    analyst.take(Handover(1, handed, publish=True, store=False))
    analyst.close()
    (told,) = (answer for answer in answers if isinstance(answer, Publication))
    assert all((edge.status == PRIOR).any() for edge in told.flow_map.edges)


def test_the_daemon_refuses_a_prior_that_does_not_fit_before_it_listens(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    path = named(project, "names.npz").path
    assert ends("run", path, "--bus", "virtual:nobody", "--test-bus", "--for", "1") == 3
    assert "p_to_a" in capsys.readouterr().err
