"""Effects of [[added]] on board: a leak is learned beside the maps, what cannot be is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rtid.effects
from rtid.daemon.daemon import Bus, Daemon, DaemonError
from rtid.effects import Effect, View, from_expression, names_of_model
from rtid.effects.extra import VOLUME
from rtid.effects.flow_sums import FlowSums
from rtid.estimator.estimator import Estimator
from rtid.plain import FloatArray
from rtid.project import Project
from rtid.project.added import AddedSection, ParameterSection
from rtid.project.schema import DynamicsSection, LagSection
from rtid.sim.bus import run_frames
from rtid.sim.hidden import hide, hide_wish
from rtid.sim.run import simulate
from rtid.sim.run_files import START_US
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.on_board import learned_sizes, load_for, on_board
from rtid.trace.described import catalog_of
from rtid.trace.learner import Learner
from rtid.trace.snapshot import SnapshotError, save
from tests.faults.harness import drift, machine

LEAK, DELAY = "internal_leakage_laminar", "input_delay"


def added(effect: str, where: str, sd: float | None = None, **values: float) -> AddedSection:
    told = {name: ParameterSection(value=v, sd=sd, unit="1") for name, v in values.items()}
    return AddedSection(effect=effect, where=where, parameters=told)


def with_added(*effects: AddedSection) -> Project:
    project = machine().project
    return replace(project, sections=replace(project.sections, added=effects))


def learned(project: Project, plant: SimulatedPlant) -> Estimator:
    """What a learner on board makes of 30 s of a plant."""
    frames = run_frames(simulate(plant, "rich", 1, 30.0), start_us=START_US)
    learner = Learner(project.model, catalog_of(project), project.assembly, project.flows)
    learner.push(frames)
    return learner.estimator


@pytest.mark.long
def test_a_leak_is_learned_beside_the_maps() -> None:
    """The maps are those of the machine without the leak; with the plain model they are not."""
    worn = hide_wish(SimulatedPlant(), f"{LEAK}=strong")
    (leak,) = (h.strength for h in worn.hidden)
    board = on_board(with_added(added(LEAK, "a-b", coefficient=1.2 * leak)), lambda _: None)
    clean = learned(machine().project, SimulatedPlant()).solution()
    plain, beside = (learned(p, worn).solution() for p in (machine().project, board))
    found = beside.terms[0]
    print(f"leak {found / leak:.3f} of the true one; drift {drift(clean, beside):.4f} beside, "
          f"{drift(clean, plain):.4f} without the effect")  # fmt: skip
    assert found == pytest.approx(leak, rel=0.1)  # the simulated gap widens with pressure
    assert drift(clean, beside) < 0.01 < 0.1 < drift(clean, plain)
    ((name, size, sd, unit),) = learned_sizes(board, beside)
    assert name == f"{LEAK} a-b" and unit == "1"
    assert size == pytest.approx(found) and sd == pytest.approx(np.sqrt(beside.terms_cov[0, 0]))


@pytest.mark.slow
def test_a_volume_that_was_found_is_the_chamber_s_own() -> None:
    """As a term it traded with the modulus, whose interval did not say so: half of the true one."""
    extra_m3, told = 3e-4, list[str]()
    plant = hide(SimulatedPlant(), "extra_dead_volume", extra_m3, "b")
    volume = added("extra_dead_volume", "b", sd=0.2 * extra_m3, volume=extra_m3)
    board = on_board(with_added(volume), told.append)
    assert board.model.terms == () and board.digest != machine().project.digest
    assert told == ["Extra dead volume at b is part of the chamber's volume"]
    solution = learned(board, plant).solution()
    print(1e-6 * solution.beta_pa, 1e-6 * solution.beta_sd_pa)
    assert solution.beta_pa == pytest.approx(plant.beta_pa, rel=0.01)


def test_the_lag_that_a_record_told_is_taken_on_board() -> None:
    """None is found there: 2 ms that quick assumes, for 1.3, moved the modulus by 1 to 3 %."""
    project = machine().project
    lag = replace(project.model.lag, nominal_s=2e-3)
    spool_lag = LagSection(nominal_s=2e-3, tolerance_s=5e-3, seen_s=1.3e-3)
    dynamics = DynamicsSection(spool_lag=spool_lag)
    sections = replace(project.sections, dynamics=dynamics)
    assumed = replace(project, model=replace(project.model, lag=lag), sections=sections)
    board = on_board(assumed, lambda _: None)
    assert board.model.lag == replace(lag, nominal_s=1.3e-3) and board.digest != assumed.digest


def test_what_the_motion_does_not_show_stays_as_it_was_found() -> None:
    leak = added(LEAK, "a-b", coefficient=5e-12, sd=1e-12)
    board = on_board(with_added(leak), lambda _: None)
    solution = Estimator(board.model).solution()
    assert solution.terms_theta[0] == pytest.approx(1.0, rel=1e-3)
    assert np.sqrt(solution.terms_cov[0, 0]) == pytest.approx(1e-12, rel=1e-3)


FORMULA = "(p_a - p_b) * exp(0 * x)"  # a leak in a form that no kernel knows


@rtid.effects.define("m3/s/Pa", chambers={"a": -1, "b": 1})
def gap(view: View) -> FloatArray:
    """The same in Python."""
    return view.p["p_a"] - view.p["p_b"]


def in_words(project: Project) -> Effect:
    return from_expression(
        "gap", FORMULA, "m3/s/Pa", names=names_of_model(project.model), chambers={"a": -1, "b": 1}
    )


def with_own(effect: Effect, leak: float) -> Project:
    project = with_added(added("gap", "a-b", coefficient=leak))
    return on_board(replace(project, effects=(effect,)), lambda _: None)


def test_a_flow_that_no_kernel_knows_is_learned_as_well() -> None:
    """Evaluated beside the kernels, it gives what the term of a leak gives, to the last percent."""
    worn = hide_wish(SimulatedPlant(), f"{LEAK}=strong")
    (leak,) = (h.strength for h in worn.hidden)
    board = with_own(in_words(machine().project), 1.2 * leak)
    assert [s.kind for s in board.model.signals][-1] == VOLUME
    found = 1.2 * leak * learned(board, worn).solution().terms_theta[0]
    print(f"leak {found / leak:.4f} of the true one")
    assert found == pytest.approx(leak, rel=0.1)


def test_live_flows_do_not_depend_on_how_samples_come() -> None:
    """Bit for bit, and a function gives what a formula gives."""
    project = machine().project
    chunk = machine().learner().push(machine().frames[:3000])
    flows = with_own(in_words(project), 5e-12).flows
    whole, pieces = FlowSums(flows).with_flows(chunk), FlowSums(flows)
    cuts = np.split(chunk, [0, 1, 2, 2, 7, 100, 101, 500])  # also none: a tick of the daemon
    np.testing.assert_array_equal(np.concatenate([pieces.with_flows(c) for c in cuts]), whole)
    drop = chunk[:, 2 + project.model.column("p_a")] - chunk[:, 2 + project.model.column("p_b")]
    flowed = 5e-12 * 0.5 * (drop[1:] + drop[:-1]) * np.diff(chunk[:, 0])
    np.testing.assert_allclose(np.diff(whole[:, -1]), flowed, atol=1e-9 * np.abs(flowed).max())
    few = chunk[:300]
    in_python = FlowSums(with_own(gap, 5e-12).flows).with_flows(few)
    np.testing.assert_allclose(in_python[:, -1], whole[:300, -1], rtol=1e-9, atol=1e-18)


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


def test_an_effect_of_size_zero_is_no_column() -> None:
    """Everything was divided by it: no status came, and the live page stood still."""
    said: list[str] = []
    board = on_board(with_added(added(LEAK, "a-b", coefficient=0.0)), said.append)
    assert board.model.terms == () and "its size in the file is 0" in said[0]


def test_noise_that_is_to_be_estimated_is_refused_at_the_start(tmp_path: Path) -> None:
    project = replace(machine().project, noise_unknown=("p_a", "x"))
    with pytest.raises(DaemonError, match="noise of p_a, x is to be estimated") as refused:
        Daemon(project, Bus("virtual", "x", lambda: pytest.fail("opened")), tmp_path)
    assert "rtid check" in refused.value.remedy
