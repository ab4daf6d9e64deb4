"""A hydraulic motor between valves that goes round for ever: its volumes stay, its angle grows.

The motor is Modelica text compiled by rumoca, after textbooks (`tests.campaign.modelica`).
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import pytest

from rtid.mcu.errors import ValveError
from rtid.mcu.valve import one_valve
from rtid.project import ProjectError, load
from rtid.study.quick import Quick, quick
from tests.campaign.laws import of_run, outcome_of
from tests.campaign.modelica import LEVER, MOTOR, Textbook

pytest.importorskip("rumoca")
MACHINE = """
[project]
name = "winch"

[source]
time_column = "t_s"
time_unit = "s"

[signals]
u = {column = "u_v", unit = "V"}
p_a = {column = "p_a_bar", unit = "bar", noise = 0.05}
p_b = {column = "p_b_bar", unit = "bar", noise = 0.05}
p_supply = {column = "p_supply_bar", unit = "bar", noise = 0.05}
p_tank = {constant = 1, unit = "bar"}
x = {column = "theta_deg", unit = "deg", noise = 0.1}

[chambers.a]
pressure = "p_a"
sign = 1
displacement_cm3 = 50
dead_volume_l = 0.5

[chambers.b]
pressure = "p_b"
sign = -1
displacement_cm3 = 50
dead_volume_l = 0.5

[edge_defaults]
u_grid_v = [1, 5, 10]
dp_grid_mpa = [0, 4, 8]
safe_band_v = 1
rated_flow_lpm = 10
rated_dp_mpa = 0.5

[edges]
pa = {source = "p_supply", sink = "p_a", direction = 1}
at = {source = "p_a", sink = "p_tank", direction = -1}
pb = {source = "p_supply", sink = "p_b", direction = -1}
bt = {source = "p_b", sink = "p_tank", direction = 1}
"""


def test_a_motor_s_volumes_stay(tmp_path: Path) -> None:
    file = tmp_path / "winch.toml"
    file.write_text(MACHINE)
    project = load(file)
    turned, model = np.array([0.0, 1e5]), project.model
    for chamber, sign in zip(model.chambers, (1, -1), strict=True):
        np.testing.assert_allclose(chamber.volume(turned), 0.5e-3)
        assert chamber.sign == sign and chamber.area_m2 == pytest.approx(50e-6 / math.tau)
    assert model.signals[model.column("x")].unit == "rad"
    with pytest.raises(ValveError, match="goes round"):
        one_valve(model, "a", ())


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("[chambers.a]", "[geometry]\nstroke_mm = 500\n[chambers.a]", "displacement_cm3"),
        ("displacement_cm3 = 50", "area_cm2 = 20", "geometry"),
        ("displacement_cm3 = 50", "displacement_cm3 = 50\narea_cm2 = 20", "chambers.a.area_cm2"),
        ("displacement_cm3 = 50", "displacement_cm3 = -1", "displacement_cm3"),
    ],
)
def test_what_a_motor_has_not_is_said(tmp_path: Path, old: str, new: str, place: str) -> None:
    assert old in MACHINE
    file = tmp_path / "winch.toml"
    file.write_text(MACHINE.replace(old, new, 1))
    with pytest.raises(ProjectError) as caught:
        load(file)
    assert any(place in problem.path for problem in caught.value.problems)


@pytest.mark.long
def test_a_motor_is_learned_while_it_goes_round() -> None:
    """Some forty turns: its maps, and the bulk modulus of both sides in their intervals."""
    plant = Textbook(MOTOR, 7101)
    run = plant.run()
    assert run is not None and np.ptp(run.truth.signals[:, 5]) > 20 * math.tau
    said = outcome_of(plant, of_run(plant, run, plant.machine), time.process_time())
    assert said.verdict == "matches" and np.abs(said.beta_z).max() < 3.0
    assert np.abs(said.valid.error).mean() < 0.003


@pytest.mark.long
def test_quick_finds_a_motor_and_its_leak(tmp_path: Path) -> None:
    """A table with an angle of many turns; the leak counts in the displacement that is assumed."""
    plant = Textbook(MOTOR, 7102, hidden="internal_leakage_laminar")
    run = plant.run()
    assert run is not None
    u, p_a, p_b, p_s, _, x, _ = run.samples.values.T
    rows = [1e-6 * run.samples.t_us, u, 1e-5 * p_a, 1e-5 * p_b, 1e-5 * p_s, np.degrees(x)]
    table, head = tmp_path / "winch.csv", "t_s,u_V,p_a_bar,p_b_bar,p_supply_bar,theta_deg"
    np.savetxt(table, np.column_stack(rows), "%.7g", ",", header=head, comments="")
    looked = quick(table)
    assert isinstance(looked, Quick) and looked.machine.goes_round
    found = {f.effect: f.parameters for f in looked.diagnosis.found} if looked.diagnosis else {}
    truth = 4e-12 * (50e-6 / math.tau) / (plant.drawn.constants.area_a_m2 / LEVER)
    size = found["internal_leakage_laminar"]["coefficient"].value
    assert size == pytest.approx(truth, rel=0.1)
    (tmp_path / "winch.toml").write_text(looked.text_for(tmp_path / "winch.toml"))
    assert all(c.is_constant for c in load(tmp_path / "winch.toml").model.chambers)
