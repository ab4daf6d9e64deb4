"""Which column of a stranger's table plays which role, in which unit; what is refused, and why."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rtid.cli.exits import Exit
from rtid.errors import RtidError
from rtid.plain import FloatArray
from rtid.project import load
from rtid.project.guess import propose
from rtid.study.quick_machine import Given, first_machine
from rtid.study.quick_project import of_units, project_text
from rtid.trace.quick_source import open_source, refuse_unknown_units, roles_of
from rtid.trace.signals import read_recording
from rtid.units import split_name
from tests.command import called
from tests.named_tables import machine, written


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
