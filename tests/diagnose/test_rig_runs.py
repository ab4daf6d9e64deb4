"""The rig of somebody else's simulator, out of the box: one project file, no settings per run.

Its labels are read here and nowhere else; nothing is tuned to them.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from rtid.diagnose.report import Diagnosis
from rtid.diagnosing import diagnose_trace
from rtid.project import load
from tests import rig
from tests.test_rig import real_bus_project

pytestmark = pytest.mark.hidden_effect


def diagnosed(shared: Path, run: int, folder: Path, project: Path = rig.PROJECT) -> Diagnosis:
    table = shared / "data" / "rig" / "measured" / f"rig_{run:02d}.parquet"
    log = rig.as_can_log(table, folder / "rig.blf")
    return diagnose_trace(load(project), log).diagnosis


def test_the_rig_as_it_was_built_matches(shared: Path, tmp_path: Path) -> None:
    found = diagnosed(shared, 1, tmp_path)
    assert (found.verdict, found.found) == ("matches", ())
    assert found.heldout_residual_before_m3s < 1.1 * found.noise_floor_m3s


@pytest.mark.parametrize(
    ("run", "effect", "parameter", "true"),
    [
        (5, "internal_leakage_laminar", "coefficient", 6e-12),
        (8, "input_delay", "delay", 30e-3),
        (10, "entrained_air", "fraction_at_1_atm", 0.05),
        (11, "extra_dead_volume", "volume", 1e-3),
        (13, "relief_valve", "opening_pressure", 3.6e6),
        (14, "supply_sag", "", 0.0),
    ],
)
def test_what_was_hidden_is_named_and_the_error_falls(
    shared: Path, tmp_path: Path, run: int, effect: str, parameter: str, true: float
) -> None:
    """One name, its size within 5 %, and at least three quarters of the held-out error gone."""
    found = diagnosed(shared, run, tmp_path)
    assert found.verdict == "missing"
    assert [own.effect for own in found.found] == [effect]
    if parameter:
        assert found.found[0].parameters[parameter].value == pytest.approx(true, rel=0.05)
    assert found.rho_after < 2.0 < found.rho_before
    assert found.heldout_residual_after_m3s < 0.25 * found.heldout_residual_before_m3s


def test_an_undeclared_lag_is_found(shared: Path, tmp_path: Path) -> None:
    """1.3 +- 0.2 ms; that it is not a delay of as much cannot be told from this motion."""
    text = rig.PROJECT.read_text()
    declared = "nominal_ms = 1.3\ntolerance_ms = 0.2"
    assert declared in text
    project = tmp_path / "project.toml"
    project.write_text(text.replace(declared, "nominal_ms = 0\ntolerance_ms = 0"))
    found = diagnosed(shared, 1, tmp_path, project)
    (own,) = found.found
    assert own.effect == "spool_lag_first_order"
    assert own.parameters["time_constant"].value == pytest.approx(1.3e-3, abs=0.2e-3)


@pytest.mark.parametrize(("run", "effect"), [(1, ""), (5, "internal_leakage_laminar")])
def test_a_real_bus_of_unknown_ages_tells_the_same(
    shared: Path, tmp_path: Path, run: int, effect: str
) -> None:
    """Commands at 100 Hz, pressures at 200, position at 50, offsets unknown, jitter."""
    table = shared / "data" / "rig" / "measured" / f"rig_{run:02d}.parquet"
    log = rig.as_can_log(table, tmp_path / "bus.blf", "--mode", "multirate", "--seed", "4")
    found = diagnose_trace(load(real_bus_project(tmp_path)), log).diagnosis
    assert [own.effect for own in found.found] == ([effect] if effect else [])
    assert found.verdict == ("missing" if effect else "matches")
    if effect:
        assert found.found[0].parameters["coefficient"].value == pytest.approx(6e-12, rel=0.05)
