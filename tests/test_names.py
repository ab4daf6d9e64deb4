"""Names and units of columns, through every door: the same record means the same in every file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge import catalog
from firmware_bridge.sources import read_table
from rtid.cli.exits import Exit
from rtid.compare.reference import GainTable
from rtid.maps.datasheet import read_reference
from rtid.plain import FloatArray
from rtid.project import load
from rtid.project.guess import from_catalog, propose
from rtid.study.quick_project import of_missing
from rtid.trace.quick_source import open_source, roles_of
from rtid.units import find_unit, split_name
from tests.command import called
from tests.named_tables import machine, written
from tests.test_init import filled_in

BOOM = {"u": ("u_boom_pct", "%"), "x": ("x_boom_cm", "cm")}
EHA = {
    "p_a": ("pA_bar", "bar"),
    "p_b": ("pB_bar", "bar"),
    "x": ("x_mm", "mm"),
    "u": ("n_rpm", "rpm"),
}
STRANGERS = {
    **dict.fromkeys([f"eha_{n}.parquet" for n in ("1_1", "1_3", "2_2", "2_4", "3_1", "3_3")], EHA),
    "excavator_manual_1016_1720.csv": BOOM,
    "excavator_manual_1016_1735.csv": BOOM,
    "excavator_manual_mitch_1101_2319.csv": BOOM,
    "excavator_manual_ol_1006_1648.csv": BOOM | {"x": ("x_boom_mm", "mm")},
    "mr_damper.csv": {"u": ("v_cm_s", "cm/s"), "x": ("F_N", "N")},
    "quadrotor_thrust.parquet": {f"u{k}": (f"motor_{k}", "PWM") for k in (1, 2, 3, 4)}
    | {"x": ("acc_z_g", "g")},
    # the force is what is measured, the pressure gives it, the friction goes by the motion
    **{
        f"seal_oring_{p}bar.csv": {"x": ("F_N", "N"), "u": ("p_bar", "bar"), "s": ("x_mm", "mm")}
        for p in (1, 3, 5)
    },
}


def roles_told(text: str) -> dict[str, tuple[str, str]]:
    """Roles that `rtid init` prints: column and what it says of the unit."""
    return {r: (c, u) for r, c, u in re.findall(r"^  (\w+) +(\S+) \[(.*)\]$", text, re.M)}


@pytest.mark.parametrize(
    ("title", "expected"),
    [
        ("p_s [Pa]", ("p_s", "Pa")),
        ("p_a (MPa)", ("p_a", "MPa")),
        ("p_A / bar", ("p_A", "bar")),
        ("v/(m/s)", ("v", "m/s")),
        ("Position mm", ("Position", "mm")),
        ("x_mm", ("x", "mm")),
        ("p_bar", ("p", "bar")),
        ("t_ms", ("t", "ms")),
        ("v_cm_s", ("v", "cm/s")),
        ("pP_bar", ("pP", "bar")),
        ("n_rpm", ("n", "rpm")),
        ("p [barg]", ("p", "barg")),
        ("p [N/mm2]", ("p", "MPa")),
        ("q_lpm", ("q", "L/min")),
        ("Q_calibrated_l_min", ("Q_calibrated", "L/min")),
        ("u_boom_pct", ("u_boom", "%")),
        ("F_N", ("F", "N")),
        ("u [-]", ("u", "")),
        *[(name, (name, "")) for name in ("p_a", "p_s", "p_in", "p_us", "x_min", "p/p0", "P_PA")],
    ],
)
def test_a_name_tells_its_unit_and_nothing_that_it_does_not_say(
    title: str, expected: tuple[str, str]
) -> None:
    assert split_name(title) == expected


@pytest.mark.parametrize("name", list(STRANGERS))
def test_init_reads_the_names_of_strangers(shared: Path, tmp_path: Path, name: str) -> None:
    table, project = shared / "data" / "strangers" / name, tmp_path / "p.toml"
    done = called("init", table, "-o", project)
    assert done.returncode == Exit.OK, done.stderr
    assert roles_told(done.stdout) == STRANGERS[name]
    used = {column for column, _ in STRANGERS[name].values()}
    told = done.stdout.partition("Not used: ")[2].splitlines()  # no such line where all are
    unused = set(told[0].split(", ")) if told else set()
    read = read_table(table)
    assert unused == set(read.columns) - used - {read.time_name()}
    stamps = read.t_us()
    assert 10.0 < 1e-6 * (stamps[-1] - stamps[0]) < 300.0, "its time is in s, ms or us"


def test_a_record_means_the_same_in_every_kind_of_file(tmp_path: Path) -> None:
    """Brackets in CSV and Parquet, units behind the name in .mat, which knows no brackets."""
    units = {"t": "s", "u": "V", "x": "mm"}
    units |= dict.fromkeys(("p_a", "p_b", "p_s", "p_t"), "bar")
    texts = []
    for suffix, title in ((".csv", "{} [{}]"), (".parquet", "{} [{}]"), (".mat", "{}_{}")):
        columns = {
            title.format(name, units[name]) if name in units else name: values
            for name, values in machine().items()
        }
        project = tmp_path / "p.toml"
        done = called("init", written(tmp_path / f"m{suffix}", columns), "-o", project, "--force")
        assert done.returncode == Exit.OK, done.stderr
        text = project.read_text()
        if suffix == ".mat":
            text = re.sub(r'(column = "\w+)_(?:s|V|mm|bar)"', r'\1"', text)
        texts.append(text)
    assert texts[0] == texts[1] == texts[2]
    loaded = load(filled_in(project))
    factors = {s.name: s.factor for s in loaded.assembly.signals if s.constant is None}
    pressures = dict.fromkeys(("p_supply", "p_tank", "p_a", "p_b"), 1e5)
    assert factors == pressures | {"x": 1e-3, "u": 1.0}


def test_a_supply_that_is_recorded_is_not_assumed(tmp_path: Path) -> None:
    """Columns named after the ports of the valve, as DIN ISO 1219 has them."""
    ports = {"p_s": "pP_bar", "p_t": "pT_bar", "p_a": "pA_bar", "p_b": "pB_bar"}
    ports |= {"x": "x_mm", "t": "t_ms"}
    columns = {ports.get(name, name): values for name, values in machine().items()}
    columns["t_ms"] *= 1e3
    path = written(tmp_path / "ports.parquet", columns)
    source = open_source(path, None)
    roles = roles_of(path, source)
    assert {role: one.name for role, one in roles.items()} == {
        "p_supply": "pP_bar", "p_tank": "pT_bar", "p_a": "pA_bar", "p_b": "pB_bar", "x": "x_mm",
        "u": "u",
    }  # fmt: skip
    assert of_missing(roles, None) == []
    assert source.keys == {"time_column": "t_ms", "time_unit": "ms"}
    assert source.step_ms == pytest.approx(1.0)


def test_one_column_plays_one_role(tmp_path: Path) -> None:
    """Its unit is guessed, for every role anew; it once was p_supply and p_a."""
    columns = machine()
    columns["P_line_1"] = columns.pop("p_a") * 1e5
    del columns["p_s"]
    done = called("init", written(tmp_path / "m.csv", columns), "-o", tmp_path / "p.toml")
    columns_told = [column for column, _ in roles_told(done.stdout).values()]
    assert sorted(columns_told) == sorted(set(columns_told)), done.stdout
    assert "P_line_1" in columns_told


def test_signals_of_a_dbc_tell_their_units_by_their_names(tmp_path: Path) -> None:
    """The DBC gives none; a unit that it gives goes before the name."""
    dbc = tmp_path / "m.dbc"
    dbc.write_text(
        'VERSION ""\nBS_: \nBU_: X\nBO_ 256 State: 8 X\n'
        ' SG_ Pos_mm : 0|16@1+ (0.1,0) [0|500] "" X\n'
        ' SG_ pA_bar : 16|16@1+ (0.01,0) [0|250] "" X\n'
        ' SG_ pB_bar : 32|16@1+ (1000,0) [0|25000000] "Pa" X\n'
    )
    roles = propose(from_catalog(catalog.load(dbc)))
    told = {role: (one.name, one.unit, one.guessed_unit) for role, one in roles.items()}
    assert told["x"] == ("Pos_mm", "mm", False)
    assert told["p_a"] == ("pA_bar", "bar", False)
    assert told["p_b"] == ("pB_bar", "Pa", False)


def project_of(tmp_path: Path, table: Path, **changed: str) -> Path:
    project = tmp_path / "p.toml"
    assert called("init", table, "-o", project, "--force").returncode == Exit.OK
    path = filled_in(project)
    for old, new in changed.items():
        path.write_text(path.read_text().replace(f'unit = "{old}"', f'unit = "{new}"'))
    return path


def test_a_project_in_another_unit_than_the_column_is_refused(tmp_path: Path) -> None:
    """`check`, as replay and diagnose, which open the table at the same place."""
    columns = machine()
    columns["x [mm]"] = columns.pop("x")
    table = written(tmp_path / "m.parquet", columns)
    project = project_of(tmp_path, table, mm="cm")
    done = called("check", project, table)
    assert done.returncode == Exit.INPUT
    assert "column 'x' is in mm, signals.x.unit says cm" in done.stderr
    assert 'set signals.x.unit = "mm", or give scale = 1.0 to insist' in done.stderr
    project.write_text(project.read_text().replace('unit = "cm"', 'unit = "cm"\nscale = 1.0'))
    assert "says cm" not in called("check", project, table).stderr


def test_a_gauge_pressure_counts_from_the_air(tmp_path: Path) -> None:
    columns = machine()
    table = written(
        tmp_path / "m.csv", {n.replace("p_a", "p_a [barg]"): v for n, v in columns.items()}
    )
    loaded = load(project_of(tmp_path, table))
    (p_a,) = [s for s in loaded.assembly.signals if s.name == "p_a"]
    assert (p_a.factor, p_a.offset) == (1e5, 101325.0)
    unit = find_unit("psig")
    assert unit is not None and unit.si(0.0) == 101325.0


PLANT = """
[plant]
name = "lag"
time_column = "t_ms"
[inputs.u]
column = "u"
[states.x]
rate = "b*u - a*x"
start = 0
unit = "mm"
[outputs.y]
value = "x"
column = "x [mm]"
unit = "mm"
[parameters.a]
start = 1
low = 0.1
high = 100
[parameters.b]
start = 1
low = 0.1
high = 100
"""


def test_refit_takes_the_time_in_its_unit_and_a_column_with_its_brackets(tmp_path: Path) -> None:
    """a = 5 per s, in a table whose time is in ms; once taken for s, and a for 0.005."""
    t: FloatArray = 0.01 * np.arange(400, dtype=np.float64)
    u: FloatArray = np.where(t % 2 < 1, 1.0, -1.0)
    x: FloatArray = np.zeros(400)
    for k in range(399):
        x[k + 1] = x[k] * np.exp(-0.05) + 0.4 * u[k] * (1 - np.exp(-0.05))
    table = written(tmp_path / "m.parquet", {"t_ms": 1e3 * t, "u": u, "x [mm]": x})
    (plant := tmp_path / "lag.toml").write_text(PLANT)
    done = called("refit", plant, table, "--json")
    assert done.returncode == Exit.OK, done.stderr
    values = {p["name"]: p["value"] for p in json.loads(done.stdout)["parameters"]}
    assert values["a"] == pytest.approx(5.0, rel=1e-3)
    assert values["b"] == pytest.approx(2.0, rel=1e-3)
    plant.write_text(PLANT.replace('column = "x [mm]"\nunit = "mm"', 'column = "x"\nunit = "m"'))
    done = called("refit", plant, table)
    assert done.returncode == Exit.INPUT
    assert "column 'x' is in mm, outputs.y.unit says m" in done.stderr


def test_no_column_of_a_table_is_lost(tmp_path: Path) -> None:
    """Names that differ by their brackets alone, and one name twice."""
    path = tmp_path / "t.csv"
    path.write_text("t,p (rod),p (cap),x,x\n0,1,2,3,4\n1,1,2,3,4\n")
    read = read_table(path)
    assert {name: column[0] for name, column in read.columns.items()} == {
        "t": 0.0, "p (rod)": 1.0, "p (cap)": 2.0, "x": 3.0, "x.2": 4.0
    }  # fmt: skip


def test_a_data_sheet_may_name_its_units_in_either_way(tmp_path: Path) -> None:
    rows = "\n".join(f"{p},{u},{3 * u}" for p in (0.5, 1) for u in (1, 2, 5))
    found = []
    for header in ("dp_MPa,u_V,Q_l_min", "dp [MPa],u [V],Q [L/min]", "dp / MPa,u / V,Q_lpm"):
        (path := tmp_path / "sheet.csv").write_text(f"{header}\n{rows}\n")
        (table,) = read_reference(path).tables.values()
        assert isinstance(table, GainTable)
        found.append(table.gain.tolist())
    assert found[0] == found[1] == found[2]
