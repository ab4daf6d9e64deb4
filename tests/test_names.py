"""Names and units of columns, through every door: the same record means the same in every file."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from firmware_bridge import catalog
from firmware_bridge.sources import read_table
from rtid.cli.exits import Exit
from rtid.compare.reference import GainTable
from rtid.errors import RtidError
from rtid.maps.datasheet import read_reference
from rtid.plain import FloatArray
from rtid.project import load
from rtid.project.guess import from_catalog, propose
from rtid.study.quick_machine import Given, first_machine
from rtid.study.quick_project import of_missing, of_units, project_text
from rtid.trace.quick_source import open_source, refuse_unknown_units, roles_of
from rtid.trace.signals import read_recording
from rtid.units import find_unit, split_name
from tests.command import called
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


def machine() -> dict[str, FloatArray]:
    """A second of a machine, by columns in bar and mm; the supply stands at 70 bar."""
    t = 0.001 * np.arange(1000)
    way = np.sin(6 * t)
    columns = {"t": t, "u": 8 * way, "x": 200 + 50 * way, "p_a": 30 + 9 * way, "p_b": 20 - 9 * way}
    return columns | {"p_s": 70 + 0.5 * way, "p_t": 2 + 0.1 * way, "spare": 3 * way}


def written(path: Path, columns: dict[str, FloatArray]) -> Path:
    if path.suffix == ".parquet":
        pq.write_table(pa.table(columns), path)
    elif path.suffix == ".mat":
        savemat(path, columns)
    else:
        rows = np.column_stack(list(columns.values()))
        np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")
    return path


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


@pytest.mark.parametrize(("supply", "tank"), [
    ("Pumpendruck", "Tankdruck"), ("Versorgungsdruck", "Rücklaufdruck"),
    ("Druck Zulauf", "Druck Rücklauf"), ("p_Versorgung", "p_RUECKLAUF"),
    ("Zulaufdruck", "Ru\u0308cklaufdruck"), ("ZULAUF_DRUCK", "RÜCKLAUF_DRUCK"),
])  # fmt: skip
def test_a_machine_with_german_names(tmp_path: Path, supply: str, tank: str) -> None:
    columns = machine()
    names = {
        "t": "Zeit", "u": "Ventilstrom [mA]", "x": "Kolbenweg [mm]", "p_a": "Druck A [bar]",
        "p_b": "Druck B [bar]", "p_s": f"{supply} [bar]", "p_t": f"{tank} [bar]",
    }  # fmt: skip
    path = written(tmp_path / "m.csv", {name: columns[key] for key, name in names.items()})
    roles = roles_of(path, open_source(path, None))
    assert {role: one.name for role, one in roles.items()} == {
        "p_supply": supply, "p_tank": tank, "p_a": "Druck A", "p_b": "Druck B",
        "x": "Kolbenweg", "u": "Ventilstrom",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("factor", "unit"), [(1.0, "bar"), (0.1, "MPa"), (1e5, "Pa"), (0.35, "MPa"), (5.0, "bar")]
)
def test_the_unit_of_pressures_is_the_likeliest_of_a_hydraulic_machine(
    tmp_path: Path, factor: float, unit: str
) -> None:
    """The supply stands at 70 times the factor: 7 are no 7 bar, and 24.5 no 24.5 bar."""
    columns = machine()
    for old, new in (("p_a", "press_a"), ("p_b", "press_b"), ("p_s", "press_p")):
        columns[new] = factor * columns.pop(old)
    del columns["p_t"]
    path = written(tmp_path / "m.csv", columns)
    roles = roles_of(path, open_source(path, None))
    assert roles["p_supply"].name == "press_p"
    assert {roles[r].unit for r in ("p_a", "p_b", "p_supply")} == {unit}


def test_counts_of_a_converter_are_no_position(tmp_path: Path) -> None:
    """20,000 were 20 km of stroke, and 115,000 L of dead volume."""
    columns = machine()
    columns["x"] = np.round(4000 + 16_000 * columns["x"] / 500)
    path = written(tmp_path / "m.csv", columns)
    with pytest.raises(RtidError, match="in no unit of length") as refused:
        roles_of(path, open_source(path, None))
    assert "x_mm" in str(refused.value.remedy)


@pytest.mark.parametrize(
    ("title", "x", "says"),
    [("x [counts]", 100.0, "the position"), ("x", 200.0, "in no unit of length")],
)
def test_counts_that_are_said_or_as_large_are_no_position(
    tmp_path: Path, title: str, x: float, says: str
) -> None:
    """Those of 16 bits were um, with a stroke of 50 mm of 452."""
    columns = machine()
    columns[title] = x * columns.pop("x")
    path = written(tmp_path / "m.csv", columns)
    with pytest.raises(RtidError, match=says):
        roles_of(path, open_source(path, None))


def test_pressures_of_no_unit_s_size_are_asked_for(tmp_path: Path) -> None:
    """70,000 mbar were taken for Pa."""
    columns = machine() | {k: 1000 * v for k, v in machine().items() if k.startswith("p_")}
    path = written(tmp_path / "m.csv", columns)
    with pytest.raises(RtidError, match=r"p_s goes from .*: in no unit of pressure"):
        roles_of(path, open_source(path, None))


def test_a_unit_that_is_guessed_is_an_assumption(tmp_path: Path) -> None:
    path = written(tmp_path / "m.csv", machine())
    said_ = [a.what for a in of_units(roles_of(path, open_source(path, None)))]
    assert said_ == ["p_s, p_t, p_a, p_b are in bar, by their range", "x is in mm, by its range"]


@pytest.mark.parametrize(
    ("written_", "known"),
    [
        ("bar(a)", "bar"), ("bar abs", "bar"), ("mbar abs.", "mbar"), ("bar (absolut)", "bar"),
        ("MPa absolute", "MPa"), ("psi(g)", "psig"), ("bar(g)", "barg"), ("psia", "psi"),
    ],
)  # fmt: skip
def test_absolute_and_gauge_pressures_keep_their_unit(written_: str, known: str) -> None:
    """Behind "p_s [bar(a)]" no supply was seen, and one of 10 MPa was assumed."""
    assert split_name(f"p_s [{written_}]") == split_name(f"p_s ({written_})") == ("p_s", known)


def test_a_unit_of_pressure_that_nobody_knows_is_asked_for(tmp_path: Path) -> None:
    """A table of a cylinder was one without pressures."""
    columns = {f"{k} [kp]" if k[:2] == "p_" else k: v for k, v in machine().items()}
    path = written(tmp_path / "m.csv", columns)
    done = called("quick", path)
    assert done.returncode == Exit.INPUT
    assert "p_a [kp], p_b [kp]: no unit of pressure that is known" in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("name", "title", "says", "remedy"),
    [
        ("x", "Position [%]", "Position [%]: no unit of length", "a hundredth of the stroke"),
        ("x", "x [1/10 mm]", "x [1/10 mm]: no unit of length", "write mm"),
        ("u", "u [mA/10]", "u [mA/10]: no unit of a command", "write V, mV, A, mA, %"),
    ],
)
def test_a_unit_that_takes_a_role_away_is_named(
    tmp_path: Path, name: str, title: str, says: str, remedy: str
) -> None:
    """No signal "could be the position"; what stood against it, nobody said."""
    columns = machine()
    columns[title] = columns.pop(name)
    path = written(tmp_path / "m.csv", columns)
    source = open_source(path, None)
    with pytest.raises(RtidError, match=re.escape(says)) as refused:
        refuse_unknown_units(path, source, propose(source.signals))
    assert remedy in str(refused.value.remedy)


def test_a_command_in_per_mille_is_one_in_per_cent(tmp_path: Path) -> None:
    """Its project counts in %, as its grid does."""
    columns = machine()
    columns["u [‰]"] = 100.0 * columns.pop("u")
    path = written(tmp_path / "m.csv", columns)
    source = open_source(path, None)
    roles = roles_of(path, source)
    project = tmp_path / "p.toml"
    machine_ = first_machine(roles, Given())
    project.write_text(project_text("m", source, roles, machine_))
    loaded = load(project)
    u = read_recording(loaded, path).samples.column("u")
    assert np.abs(u).max() == pytest.approx(80.0, rel=1e-3)
    assert next(s.unit for s in loaded.model.signals if s.name == "u") == "%"


@pytest.mark.parametrize("title", ["p_t [Pa]", "p_a [Pa]", "u [V]"])
def test_a_column_of_no_numbers_that_would_play_a_role_is_named(tmp_path: Path, title: str) -> None:
    """A tank that was measured was assumed, for a separator of thousands."""
    columns = machine()
    del columns[title[: title.index(" ")]]
    rows = np.column_stack(list(columns.values()))
    lines = [",".join([*columns, title]), *(",".join(map(str, row)) + ',"1,013.5"' for row in rows)]
    path = tmp_path / "m.csv"
    path.write_text("\n".join(lines))
    says = f"{title}: '1,013.5' in line 2 is no number"
    with pytest.raises(RtidError, match=re.escape(says)) as refused:
        open_source(path, None)
    assert "no separators of thousands" in str(refused.value.remedy)


def test_a_time_that_is_none_is_named(tmp_path: Path) -> None:
    path = tmp_path / "m.csv"
    path.write_text("Time,u\n59:58.0,1\n59:58.1,2\n")
    with pytest.raises(RtidError, match=r"Time: '59:58.0' in line 2") as refused:
        open_source(path, None)
    assert "14:05:09.250" in str(refused.value.remedy)


@pytest.mark.parametrize("pattern", ["{}{}", "{}_{}", "cyl{1}_{0}"])
def test_of_two_cylinders_that_are_numbered_one_is_taken(tmp_path: Path, pattern: str) -> None:
    """The 2 of p_b2 was one more word for chamber b: of one cylinder were p_a, u and x."""
    both = [(k, n) for n in (1, 2) for k in ("u", "x", "p_a", "p_b")]
    columns = machine()
    numbered = {pattern.format(k, n): columns[k] + n for k, n in both}
    path = written(tmp_path / "m.csv", {"t": columns["t"], **numbered, "p_s": columns["p_s"]})
    roles = roles_of(path, open_source(path, None))
    of_one = {role: pattern.format(role, 1) for role in ("u", "x", "p_a", "p_b")}
    assert {role: c.name for role, c in roles.items()} == of_one | {"p_supply": "p_s"}


@pytest.mark.parametrize(
    "names",
    [
        "Temps,Commande,Position,Pression A,Pression B,Pression pompe,Pression retour",
        "Tempo,Comando,Posição,Pressão A,Pressão B,Pressão bomba,Pressão tanque",
        "Tempo,Comando,Curso,Pressão pistão,Pressão haste,Pressão de alimentação,Pressão retorno",
        "Zeit,Stellsignal,Weg,Druck Kolbenseite,Druck Stangenseite,Pumpendruck,Rücklauf",
        "Czas,Sterowanie,Położenie,Ciśnienie A,Ciśnienie B,Ciśnienie zasilania,Ciśnienie powrotu",
        "czas,zawór,pozycja,cisnienie A,cisnienie B,cisnienie pompy,cisnienie zbiornika",
        "时间,阀指令,活塞位移,A腔压力,B腔压力,供油压力,回油压力",
        "时间,控制信号,位移,无杆腔压力,有杆腔压力,泵压力,油箱压力",
        "Time,Valve::u,Motion::x,Press::p_a,Press::p_b,Press::p_s,Press::p_t",
        "time,u:1,x:1,p_a:1,p_b:1,p_s:1,p_t:1",
        "time,u\\CCP:1,x\\CCP:1,p_a\\CCP:1,p_b\\CCP:1,p_s\\CCP:1,p_t\\CCP:1",
    ],
)
def test_other_languages_have_a_time_a_supply_and_a_tank(tmp_path: Path, names: str) -> None:
    """No column looked like time; a supply that was measured was assumed."""
    columns, units = list(machine().values())[:7], ("s", "V", "mm", "bar", "bar", "bar", "bar")
    titles = [f"{name} [{unit}]" for name, unit in zip(names.split(","), units, strict=True)]
    roles = roles_of(
        path := written(tmp_path / "m.csv", dict(zip(titles, columns, strict=True))),
        open_source(path, None),
    )
    order = ("u", "x", "p_a", "p_b", "p_supply", "p_tank")
    assert [roles[role].name for role in order] == names.split(",")[1:]


@pytest.mark.parametrize(
    "coarse",
    [lambda t: np.round(t, 2), lambda t: 45_352 + t / 86_400],
    ids=["10 ms", "days, and no unit"],
)
def test_a_time_that_stands_while_rows_come_is_refused(
    tmp_path: Path, coarse: Callable[[FloatArray], FloatArray]
) -> None:
    """Four of five rows were left out, or the fault was one of a file that nobody has."""
    columns = machine()
    t = columns.pop("t")
    fine = {"t": coarse(t[0] + 0.002 * np.arange(len(t)))} | columns
    np.savetxt(
        tmp_path / "m.csv", np.column_stack([*fine.values()]), "%.12g", ",",
        header=",".join(fine), comments="",
    )  # fmt: skip
    with pytest.raises(RtidError, match="times for") as refused:
        open_source(tmp_path / "m.csv", None)
    assert "[d]" in str(refused.value.remedy)


def test_rows_of_one_time_that_tell_signals_in_turn_are_read(tmp_path: Path) -> None:
    """Four rows for each time, each with a signal of its own: none of them tells another time."""
    names, lines = ("u [V]", "x [mm]", "p_a [bar]", "p_b [bar]"), list[str]()
    for k in range(200):
        for j in range(4):
            told = ["", "", "", ""]
            told[j] = f"{5.0 + np.sin(0.1 * k + j):.5f}"
            lines.append(f"{0.01 * k:.2f},{','.join(told)}")
    path = tmp_path / "m.csv"
    path.write_text("\n".join([f"t [s],{','.join(names)}", *lines]) + "\n")
    assert [c.stem for c in open_source(path, None).signals] == ["u", "x", "p_a", "p_b"]


@pytest.mark.parametrize("overlap", [False, True])
@pytest.mark.parametrize("prefix", ["", "valve - "])
def test_a_coil_for_either_direction_is_one_command(
    tmp_path: Path, overlap: bool, prefix: str
) -> None:
    """Never at once: their difference; else they are two, of which one is taken."""
    columns, way = machine(), machine()["u"]
    del columns["u"], columns["spare"]
    columns[f"{prefix}out_pct"] = np.maximum(way, -0.05) + (3.0 if overlap else 0.0)
    columns[f"{prefix}valve_in_pct"] = np.maximum(-way, -0.05)  # currents, with their noise
    path = written(tmp_path / "m.csv", columns)
    u = roles_of(path, open_source(path, None))["u"]
    assert (u.name == f"{prefix}out_pct - {prefix}valve_in_pct") is not overlap
    assert u.unit == "%" and (overlap or u.low < -7.9 < 7.9 < u.high)


def test_two_coils_that_are_told_in_turn_have_no_difference(tmp_path: Path) -> None:
    """No row holds both: it was a column of nothing."""
    columns, way = machine(), machine()["u"]
    del columns["u"]
    columns["out_pct"] = np.where(np.arange(1000) % 2, np.nan, np.maximum(way, 0.0))
    columns["valve_in_pct"] = np.where(np.arange(1000) % 2, np.maximum(-way, 0.0), np.nan)
    path = written(tmp_path / "m.csv", columns)
    assert " - " not in roles_of(path, open_source(path, None))["u"].name


@pytest.mark.parametrize("factor", [1e-3, 1e-6])
def test_a_short_stroke_is_no_count(tmp_path: Path, factor: float) -> None:
    """250 um in m: no unit makes a usual stroke of it, and it is not refused."""
    columns = machine()
    columns["x"] = factor * columns["x"]
    path = written(tmp_path / "m.csv", columns)
    assert roles_of(path, open_source(path, None))["x"].name == "x"
