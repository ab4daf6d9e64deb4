"""The zero of a pressure sensor through the commands: named, added, dropped, taken back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shutil import copy

import numpy as np
import pytest

from firmware_bridge.samples import Samples
from rtid.cli.exits import Exit
from rtid.diagnose.extend import RefusedError
from rtid.plain import silent
from rtid.project import load
from rtid.sim.recording import write_run
from rtid.sim.run import P_B, Run, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.revisions import add, without
from rtid.study.study import Study
from rtid.ui.desk import Desk
from tests.command import ends, in_json
from tests.diagnose.stops import STEP_S, against_the_stops
from tests.replays import shared_replays  # noqa: F401

ZERO, BIAS = "pressure_sensor_bias", 0.25e6
STOPS = ((9.0, 3.0), (-9.0, 3.0))


def with_stops(run: Run, bias_pa: float) -> Run:
    """A run, then the machine against its stops; the sensor of b shows too much all the time."""
    values = np.vstack([run.samples.values, against_the_stops(run.plant, STOPS)])
    values[:, P_B] += bias_pa
    more = (
        run.samples.t_us[-1]
        + 1_000_000
        + np.arange(len(values) - len(run.samples)) * round(1e6 * STEP_S)
    )
    t_us = np.concatenate([run.samples.t_us, more])
    flags = np.resize(run.samples.flags[1:], len(values))
    return replace(run, samples=Samples(run.samples.names, t_us, values, flags))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    trace = tmp_path_factory.mktemp("zero") / "trace.parquet"
    run = simulate(SimulatedPlant(), "rich", 0, 40.0)
    write_run(trace, with_stops(run, BIAS), 0, "rich")
    return trace


@pytest.fixture
def project(recorded: Path, tmp_path: Path) -> Path:
    return Path(copy(recorded.with_suffix(".toml"), tmp_path / "machine.toml"))


def test_a_zero_is_named_added_and_taken_back(project: Path, recorded: Path) -> None:
    old = project.read_bytes()
    done = in_json("add", recorded, "--project", project)
    assert [(c["effect"], c["where"]) for c in done["changes"]] == [(ZERO, "p_b")]
    loaded = load(project)
    assert loaded.sections.zeros_pa["p_b"] == pytest.approx(BIAS, abs=2e3)
    assert loaded.sections.parts == ()

    study = Study(project, recorded)
    shown = study.read.samples.values[:, P_B]
    raw = Study(recorded.with_suffix(".toml"), recorded).read.samples.values[:, P_B]
    assert np.allclose(raw - shown, loaded.sections.zeros_pa["p_b"])
    said = study.diagnosis()
    assert (said.verdict, said.found) == ("matches", ())
    assert all(abs(zero.apart_pa) < 2e3 for zero in said.zeros)

    assert ends("undo", "-p", project) == Exit.OK
    assert project.read_bytes() == old


@pytest.mark.long
def test_the_maps_are_the_machine_s_once_the_zero_is_right(project: Path, recorded: Path) -> None:
    plant, u, dp = SimulatedPlant(), np.array([3.0, 4.0]), np.array([1.5e6, 2.5e6])
    errors = []
    for _ in range(2):
        map_ = Study(project, recorded).map["pb"]
        errors.append(float(np.abs(map_.flow(u, dp) / plant.flow("pb", u, dp) - 1).max()))
        add(project, recorded) if len(errors) == 1 else None
    assert errors[0] > 0.03 > 10 * errors[1]


@pytest.mark.long
def test_in_memory_it_is_what_the_file_says(project: Path, recorded: Path) -> None:
    study = Study(project, recorded)
    before = study.standing.held_out.rms_m3s
    tried = study.tried(ZERO, "p_b")
    assert tried.against == ()
    add(project, recorded)
    again = Study(project, recorded)
    assert again.standing.held_out.rms_m3s == pytest.approx(tried.after.held_out.rms_m3s, rel=1e-9)
    back, _ = without(again, again.project.sections.added[0])
    assert back.project.sections.added == ()
    assert back.standing.held_out.rms_m3s == pytest.approx(before, rel=1e-9)


@pytest.mark.long
def test_the_page_adds_it_and_the_report_tells_it(
    project: Path, recorded: Path, tmp_path: Path
) -> None:
    desk = Desk(silent)
    desk.open(project, recorded, None)
    assert [(e.effect, e.where) for e in desk.diagnose().diagnosis.found] == [(ZERO, "p_b")]
    addition = desk.add(ZERO, "p_b", "")
    assert (addition.section.key, addition.note) == ((ZERO, "p_b"), "")
    assert desk.diagnose().diagnosis.verdict == "matches"
    page = tmp_path / "report.html"
    assert ends("report", recorded, "-p", project, "--output", page) == Exit.OK
    assert "Pressure sensor bias" in page.read_text()


def test_a_zero_that_is_right_is_not_added(project: Path, recorded: Path) -> None:
    with pytest.raises(RefusedError, match="not off"):
        add(project, recorded, ZERO, "p_a")


def test_what_a_record_does_not_tell_is_not_added(project: Path, recorded: Path) -> None:
    with pytest.raises(RefusedError, match="does not tell the zero of p_tank"):
        add(project, recorded, ZERO, "p_tank")
