"""The nominal machine beside the simulated one, and a short design from file to true machine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.compare.reference import theta_cells
from rtid.errors import RtidError
from rtid.estimator.chunk import to_chunk
from rtid.estimator.estimator import Estimator
from rtid.excite import library
from rtid.excite.design import _fitted, checked, tightened
from rtid.excite.driving import SHUT, STEP_S, X_REF, Control, Piston
from rtid.excite.excitable import limits_of, machine_of, section_of
from rtid.excite.exciting import excite
from rtid.excite.machine import DrivenMachine
from rtid.excite.motion_limits import LimitError
from rtid.excite.prediction import assess
from rtid.model import Grid, Lag
from rtid.project import load
from rtid.sim.declare import declared_model
from rtid.sim.run import EXACT, P_A, P_B, U, X, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.snapshot import save
from tests.command import ends, in_json
from tests.eighty import eighty  # noqa: F401
from tests.excite.machines import machine, motion, motion_of, write_project
from tests.replays import shared_replays  # noqa: F401

NUMBER = 7
EXCITE = "external_leakage_laminar"


def exact_machine(plant: SimulatedPlant) -> DrivenMachine:
    """Everything known: the true maps on a fine grid, load, friction, controller."""
    fine = Grid(np.linspace(1.0, 9.6, 120), np.linspace(-1e6, 1e7, 45))
    model = declared_model(plant, grid=fine, lag=Lag(plant.lag_s, 0.0))
    c, k = plant.constants, plant.controller
    piston = Piston(
        c.mass_kg, c.gravity_n, c.gravity_slope_npm, 0.5 * c.stroke_m, c.viscous_nspm, c.coulomb_n
    )
    control = Control(*k)
    compliance = np.full(2, 1.0 / c.beta_pa)
    theta = theta_cells(model, plant.flow)
    return DrivenMachine(model, theta, compliance, piston, control, c.stroke_m, plant.p_supply_pa)


def few_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    """A library of a few segments: a test has not the time for all."""
    monkeypatch.setattr(library, "PACES", (0.15, 0.4))
    monkeypatch.setattr(library, "SWINGS", ((0.65, 1.0),))
    monkeypatch.setattr(library, "STEPS", ((0.5, 0.07),))
    monkeypatch.setattr(library, "PASS_STEPS", ((0.5, 0.07),))
    monkeypatch.setattr(library, "ZIGZAGS", (0.3,))


def test_the_nominal_machine_moves_as_the_simulated_one(tmp_path: Path) -> None:
    plant = machine(NUMBER)
    project = load(write_project(tmp_path, plant, NUMBER))
    limits = limits_of(section_of(project))
    segments = [s for s in library.library(limits) if "at 8.43" in s.name]
    moves = [
        next(s for s in segments if s.name.startswith(n)) for n in ("swing 0.65 of 1", "shut 0.4")
    ]
    reference = np.concatenate([s.reference for s in moves])
    true = simulate(plant, motion(reference), 0, len(reference) * STEP_S, EXACT).truth.signals
    found = exact_machine(plant).run(reference)[:, 2:]
    late = np.arange(len(found)) > 500  # they begin with other pressures at rest
    assert np.abs(found - true)[late, X].max() < 1e-3
    for column in (P_A, P_B):
        error = np.sqrt(np.mean((found - true)[late, column] ** 2))
        assert error < 0.15 * np.std(true[late, column])
    shut = reference[:, SHUT] > 0
    assert shut.any()
    assert not found[shut, U].any()


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.usefixtures("eighty")
def test_a_design_from_the_file_to_the_true_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Limits are kept, and the predicted detection limit is what a simulation then finds."""
    few_segments(monkeypatch)
    plant = machine(NUMBER)
    project, table = write_project(tmp_path, plant, NUMBER), tmp_path / "motion.csv"
    asked = ["excite", "-p", str(project), "--duration-s", "25", "--see", EXCITE, "--no-compare"]
    picture = tmp_path / "motion.svg"
    told = in_json(*asked, "--out", table, "--picture", picture)
    assert all(e["is_kept"] for e in told["extremes"])
    assert picture.stat().st_size > 10_000
    true = simulate(plant, motion_of(table), 1, told["duration_s"])
    limits = limits_of(section_of(load(project)))
    signals = true.truth.signals
    assert limits.stroke_m[0] <= signals[:, X].min() <= signals[:, X].max() <= limits.stroke_m[1]
    assert np.abs(signals[:, U]).max() <= limits.command_v + 1e-3
    model = load(project).model
    found = assess(model, to_chunk(model, true.samples, int(true.samples.t_us[0])))
    designed, sweep = told["predictions"]
    assert told["segments_worth_running"] == told["segments_tried"]
    assert found.valid == pytest.approx(designed["valid_blocks"], rel=0.3)
    assert sweep["valid_blocks"] > 50
    for limit in designed["limits"]:
        if limit["effect"] == EXCITE:
            measured = found.limit(EXCITE, limit["where"])
            assert 1 / 1.5 < measured / limit["detection_limit"] < 1.5
    learned, snapshot = Estimator(model), tmp_path / "state.npz"
    learned.update(true.samples)
    save(snapshot, learned, load(project).digest)
    assert ends(*asked, "--after", snapshot) == 0, "segments are left that are worth running"
    again = " ".join(capsys.readouterr().out.split())
    assert all(word in again for word in ("median", "±", "largest", "L/min/MPa"))
    again = in_json(*asked, "--after", snapshot)
    assert 0 < again["segments_worth_running"] <= again["segments_tried"]


def test_what_goes_too_far_is_run_smaller(tmp_path: Path) -> None:
    """A swing to the very ends: nothing of it is lost but what lies beyond the margin."""
    project = load(write_project(tmp_path, machine(NUMBER), NUMBER))
    nominal = machine_of(project, section_of(project))
    limits = tightened(limits_of(section_of(project)))
    swings = library.library(replace(limits, supply_pa=(6e6, 6e6), offset_v=0.0))
    swing = next(s for s in swings if s.name.startswith("swing 0.65 of 1 in"))
    wide = swing.scaled(1.3, library.home_m(limits))
    fitting = _fitted(nominal, limits, wide)
    assert fitting is not None
    kept, chunk = fitting
    assert all(e.is_kept for e in checked(nominal, limits, kept.reference, chunk))
    ways = [np.ptp(s.reference[:, X_REF]) for s in (kept, swing, wide)]
    assert 0.8 * ways[1] < ways[0] < ways[2]


def test_what_cannot_be_designed_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few_segments(monkeypatch)
    path = write_project(tmp_path, machine(NUMBER), NUMBER)
    project = load(path)
    with pytest.raises(RtidError, match="no effect 'leak'"):
        excite(project, ["leak"])
    with pytest.raises(LimitError, match="can follow no segment"):
        excite(project, pressure_pa=(9.0e6, 9.9e6))
    text = path.read_text("utf-8")
    path.write_text(text[: text.index("[excite]")], "utf-8")
    with pytest.raises(RtidError, match=r"no section \[excite\]"):
        excite(load(path))


def test_the_rated_flow_stands_in_for_a_data_sheet(tmp_path: Path) -> None:
    path = write_project(tmp_path, machine(NUMBER), NUMBER)
    path.write_text(path.read_text("utf-8").replace('reference_map = "sheet.csv"\n', ""), "utf-8")
    project = load(path)
    found = machine_of(project, section_of(project))
    edge = project.model.edges[0]
    assert np.abs(found.theta[:, 0]).max() == pytest.approx(
        edge.rated_q_m3s * np.sqrt(9e6 / edge.rated_dp_pa), rel=0.1
    )
