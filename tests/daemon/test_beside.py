"""Effects of [[added]] on board: a leak is learned beside the maps, what cannot be is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.compare.acting import MAKERS
from rtid.daemon.beside import load_for, on_board
from rtid.daemon.daemon import Bus, Daemon, DaemonError
from rtid.diagnose.causes import causes
from rtid.diagnose.fit import first_map
from rtid.diagnose.view import View
from rtid.effects import catalogue
from rtid.estimator.estimator import Estimator
from rtid.estimator.state import nominal_weights
from rtid.live import Learner, catalog_of
from rtid.project import Project
from rtid.project.added import AddedSection, ParameterSection
from rtid.sim.bus import run_frames
from rtid.sim.hidden import hide_wish
from rtid.sim.log import START_US
from rtid.sim.plant import Plant
from rtid.sim.run import simulate
from rtid.store import SnapshotError, save
from tests.faults.harness import drift, machine

LEAK, DELAY = "internal_leakage_laminar", "input_delay"


def added(effect: str, where: str, sd: float | None = None, **values: float) -> AddedSection:
    told = {name: ParameterSection(value=v, sd=sd, unit="1") for name, v in values.items()}
    return AddedSection(effect=effect, where=where, parameters=told)


def with_added(*effects: AddedSection) -> Project:
    project = machine().project
    return replace(project, sections=replace(project.sections, added=effects))


def learned(project: Project, plant: Plant) -> Estimator:
    """What a learner on board makes of 30 s of a plant."""
    frames = run_frames(simulate(plant, "rich", 1, 30.0), start_us=START_US)
    learner = Learner(project.model, catalog_of(project), project.assembly)
    learner.push(frames)
    return learner.estimator


def test_a_leak_is_learned_beside_the_maps() -> None:
    """The maps are those of the machine without the leak; with the plain model they are not."""
    worn = hide_wish(Plant(), f"{LEAK}=strong")
    (leak,) = (h.strength for h in worn.hidden)
    board = on_board(with_added(added(LEAK, "a-b", coefficient=1.2 * leak)), lambda _: None)
    clean = learned(machine().project, Plant()).solution()
    plain, beside = (learned(p, worn).solution() for p in (machine().project, board))
    found = beside.terms[0]
    print(f"leak {found / leak:.3f} of the true one; drift {drift(clean, beside):.4f} beside, "
          f"{drift(clean, plain):.4f} without the effect")  # fmt: skip
    assert found == pytest.approx(leak, rel=0.1)  # the simulated gap widens with pressure
    assert drift(clean, beside) < 0.01 < 0.1 < drift(clean, plain)


def test_what_the_motion_does_not_show_stays_as_it_was_found() -> None:
    leak = added(LEAK, "a-b", coefficient=5e-12, sd=1e-12)
    board = on_board(with_added(leak), lambda _: None)
    solution = Estimator(board.model).solution()
    assert solution.terms_theta[0] == pytest.approx(1.0, rel=1e-3)
    assert np.sqrt(solution.terms_cov[0, 0]) == pytest.approx(1e-12, rel=1e-3)


def test_what_cannot_run_live_is_told(tmp_path: Path) -> None:
    told: list[str] = []
    project = with_added(added(DELAY, "command", delay=0.01), added(LEAK, "a-b", coefficient=5e-12))
    board = on_board(project, told.append)
    assert len(told) == 2 and "not in the model on board" in told[0] and "learned" in told[1]
    assert len(board.model.terms) == 1 and board.digest != project.digest
    alone = with_added(added(DELAY, "command", delay=0.01))
    assert on_board(alone, told.append) is alone


def test_a_snapshot_says_what_it_was_learned_beside(tmp_path: Path) -> None:
    project, path = with_added(added(LEAK, "a-b", coefficient=5e-12)), tmp_path / "state.npz"
    board = on_board(project, lambda _: None)
    for one, live in ((project, 0), (board, 1)):
        save(path, Estimator(one.model), one.digest)
        estimator, effects = load_for(path, project)
        assert len(effects) == live == len(estimator.model.terms)
    with pytest.raises(SnapshotError):
        load_for(path, machine().project)


def test_parameters_of_the_catalogue_are_those_of_the_columns() -> None:
    """Size first, then the shape in its order: what `on_board` takes them for."""
    frames = machine().frames[:6000]
    learner = machine().learner()
    chunk = learner.push(frames)
    model, weights = machine().project.model, nominal_weights(machine().project.model)
    view = View.of(model, chunk, weights, first_map(model, chunk, weights))
    pages = catalogue()
    seen = {c.candidate.effect: c.candidate for c in causes(view) if c.candidate.effect in MAKERS}
    assert len(seen) >= 8
    for effect, candidate in seen.items():
        names = [parameter.name for parameter in pages[effect].parameters]
        assert names[1:] == list(candidate.shape_names)[: len(names) - 1], effect


def test_noise_that_is_to_be_estimated_is_refused_at_the_start(tmp_path: Path) -> None:
    project = replace(machine().project, noise_unknown=("p_a", "x"))
    with pytest.raises(DaemonError, match="noise of p_a, x is to be estimated") as refused:
        Daemon(project, Bus("virtual", "x", lambda: pytest.fail("opened")), tmp_path)
    assert "rtid check" in refused.value.remedy
