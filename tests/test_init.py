"""`rtid init`: roles by name and unit, and a file that loads once its TODOs are filled in."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
import tomlkit

from firmware_bridge import catalog
from rtid.project import ProjectError, load
from rtid.project.guess import RoleCandidate, from_catalog, propose
from tests.command import called


def init(*arguments: object) -> subprocess.CompletedProcess[str]:
    return called("init", *arguments)


def filled_in(path: Path) -> Path:
    """Every commented example with a TODO taken as the truth."""
    lines = path.read_text().splitlines()
    kept = [line[2:] if line.startswith("# ") and "TODO" in line and "=" in line else line
            for line in lines if not line.startswith("# Written")]  # fmt: skip
    path.write_text("\n".join(kept))
    return path


def test_own_dbc_gives_a_project_that_loads_once_filled_in(tmp_path: Path) -> None:
    path = tmp_path / "project.toml"
    done = init("builtin:controller.dbc", "-o", path)
    assert done.returncode == 0, done.stderr
    with pytest.raises(ProjectError) as caught:
        load(path)
    missing = {problem.path for problem in caught.value.problems}
    assert {"geometry.stroke_mm", "chambers.a.area", "edges.pa.rated_flow"} <= missing
    assert all(problem.problem == "missing" for problem in caught.value.problems)
    for problem in caught.value.problems:
        assert str(problem) in done.stdout
    project = load(filled_in(path))
    signals = {s.name: (s.message, s.signal) for s in project.assembly.signals}
    assert signals["p_a"] == ("Pressures", "PA")
    assert signals["u"] == ("ValveCommand", "U")
    assert signals["x"] == ("Motion", "X")
    assert project.model.edges[0].grid.u_v[-1] == 10.0
    steps = np.diff(project.model.edges[0].grid.u_v)
    assert steps == pytest.approx(0.25), "with 0.5 V a healthy machine's residual is 1.4 its noise"
    assert project.model.edges[0].safe_band_v == 0.0, "with none, u < 0 would be off the grid"


def test_existing_file_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "project.toml"
    path.write_text("mine")
    done = init("builtin:controller.dbc", "-o", path)
    assert (done.returncode, path.read_text()) == (2, "mine")
    assert init("builtin:controller.dbc", "-o", path, "--force").returncode == 0


def test_table_with_and_without_units(tmp_path: Path) -> None:
    t = np.arange(100) * 0.01
    columns = {"time": t, "Valve": np.sin(t), "P1 [bar]": 50 + t, "P2 [bar]": 30 + t}
    columns |= {"P_sup": 200 + t, "P_ret": 2 + t, "Pos_mm": 300 * t, "Pos_ref": 300 * t}
    table = tmp_path / "run.csv"
    rows = np.column_stack(list(columns.values()))
    np.savetxt(table, rows, delimiter=",", header=",".join(columns), comments="")
    path = tmp_path / "project.toml"
    done = init(table, "-o", path)
    assert done.returncode == 0, done.stderr
    project = load(filled_in(path))
    sources = {s.name: s for s in project.assembly.signals}
    assert [sources[n].signal for n in ("u", "p_a", "p_b", "x")] == ["Valve", "P1", "P2", "Pos_mm"]
    assert sources["p_supply"].signal == "P_sup" and sources["p_supply"].factor == 1e5
    assert sources["x"].factor == 1e-3
    assert "guessed" in done.stdout


def test_dbc_without_a_machine_says_what_is_missing(shared: Path, tmp_path: Path) -> None:
    done = init(shared / "data/can_j1939/j1939.dbc", "-o", tmp_path / "p.toml")
    assert done.returncode == 0
    assert "signals.p_a.message: missing" in done.stdout


SPNS = {  # an excavator's signals by names of their SPNs, with those of its engine and cab
    "EngOilPress": "kPa", "EngIntakeManifold1Prs": "kPa", "FuelDeliveryPress": "kPa",
    "TransOilPress": "kPa", "BrakePrimaryPress": "kPa", "AccelPedalPos1": "%",
    "EngPercentLoadAtCurrentSpeed": "%", "WheelBasedVehicleSpeed": "km/h", "EngSpeed": "rpm",
    "HydPmpOutletPress": "kPa", "HydReturnLinePress": "kPa",
    "ArmCylHeadEndPress": "kPa", "ArmCylRodEndPress": "kPa", "ArmCylExtension": "mm",
    "ArmVlvSpoolCmd": "%",
    "BoomCylHeadEndPress": "kPa", "BoomCylRodEndPress": "kPa", "BoomCylExtension": "mm",
    "BoomVlvSpoolCmd": "%", "SwingVlvCmd": "%",
}  # fmt: skip
TOLD = {"p_supply": "HydPmpOutletPress", "p_tank": "HydReturnLinePress", "u": "{}VlvSpoolCmd"}
TOLD |= {"p_a": "{}CylHeadEndPress", "p_b": "{}CylRodEndPress", "x": "{}CylExtension"}


@pytest.mark.parametrize("cylinder", ["Arm", "Boom"])
def test_roles_are_proposed_from_the_names_of_spns_and_of_one_cylinder(cylinder: str) -> None:
    other = {"Arm": "Boom", "Boom": "Arm"}[cylinder] + "CylHeadEndPress"
    signals = [RoleCandidate(n, "M", unit, 0, 1) for n, unit in SPNS.items() if n != other]
    roles = {role: candidate.name for role, candidate in propose(signals).items()}
    assert roles == {role: name.format(cylinder) for role, name in TOLD.items()}


def test_unreadable_source_is_refused(tmp_path: Path) -> None:
    (tmp_path / "broken.dbc").write_text("this is no DBC")
    done = init(tmp_path / "broken.dbc", "-o", tmp_path / "p.toml")
    assert done.returncode in (2, 3) and "broken.dbc" in done.stderr
    assert not (tmp_path / "p.toml").exists()


def test_reference_values_are_not_taken_for_measurements() -> None:
    roles = propose(from_catalog(catalog.load()))
    assert "XRef" not in {found.name for found in roles.values()}
    only_reference = [RoleCandidate("XRef", "", "m", 0.0, 1.0)]
    assert propose(only_reference) == {}


TWINS = {  # two messages of one name, as tools write them that join the buses of a machine
    "twins.dbc": """VERSION ""
NS_ :
BS_:
BU_: Unit
BO_ 100 Sensors: 8 Unit
 SG_ PA : 0|16@1+ (0.01,0) [0|600] "bar" Unit
BO_ 101 Sensors: 8 Unit
 SG_ PB : 0|16@1+ (0.01,0) [0|600] "bar" Unit
BO_ 102 Motion: 8 Unit
 SG_ X : 0|16@1+ (0.01,0) [0|500] "mm" Unit
""",
    "twins.sym": """FormatVersion=6.0 // Do not edit this line!
Title="twins"

{SENDRECEIVE}

[Sensors]
ID=064h
Len=8
Var=PA unsigned 0,16 /u:bar /f:0.01 /max:600

[Motion]
ID=066h
Len=8
Var=X unsigned 0,16 /u:mm /f:0.01 /max:500

[Sensors]
ID=065h
Len=8
Var=PB unsigned 0,16 /u:bar /f:0.01 /max:600
""",
}


@pytest.mark.parametrize("name", TWINS)
def test_two_messages_of_one_name_are_both_there(tmp_path: Path, name: str) -> None:
    """The later one took the place of the earlier one: 18 messages became 9 without a word."""
    path = tmp_path / name
    path.write_text(TWINS[name])
    found = {one.name: one.message for one in from_catalog(catalog.load(path))}
    assert found == {"PA": "Sensors-064", "PB": "Sensors-065", "X": "Motion"}
    done = init(path, "-o", tmp_path / "project.toml")
    assert done.returncode == 0, done.stderr
    written = tomlkit.parse((tmp_path / "project.toml").read_text()).unwrap()
    messages = {role: told.get("message") for role, told in written["signals"].items()}
    assert (messages["p_a"], messages["p_b"]) == ("Sensors-064", "Sensors-065")
    with pytest.raises(catalog.CatalogError, match="2 messages 'Sensors'; name one of Sensors-064"):
        catalog.load(path).message("Sensors")
