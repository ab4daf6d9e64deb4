"""Project files: what they become, and that every error is named at once with place and remedy."""

from __future__ import annotations

import tomllib
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit

import rtid.project
from rtid.estimator.state import build
from rtid.project import Problem, Project, ProjectError, load
from rtid.units import UNITS, find_unit

EXAMPLE = Path(rtid.project.__file__).parent / "examples" / "cylinder.toml"


@pytest.fixture
def raw() -> dict[str, Any]:
    return tomllib.loads(EXAMPLE.read_text())


def write(raw: dict[str, Any], folder: Path) -> Path:
    path = folder / "project.toml"
    path.write_text(tomlkit.dumps(raw))
    return path


def refused(raw: dict[str, Any], folder: Path) -> dict[str, Problem]:
    with pytest.raises(ProjectError) as caught:
        load(write(raw, folder))
    assert caught.value.exit_code == 2
    for problem in caught.value.problems:
        assert problem.remedy and str(problem) in str(caught.value)
    return {problem.path: problem for problem in caught.value.problems}


def loaded(raw: dict[str, Any], folder: Path) -> Project:
    return load(write(raw, folder))


def test_example_is_the_machine_of_the_test_rig() -> None:
    model = load(EXAMPLE).model
    a, b = model.chambers
    assert a.area_m2 == pytest.approx(0.001963495408493621)
    assert (a.sign, b.sign) == (1, -1)
    assert a.v0_m3 == pytest.approx(0.0006)
    assert b.v0_m3 == pytest.approx(0.0006 + b.area_m2 * 0.5)
    assert [(e.name, e.source, e.sink, e.direction) for e in model.edges] == [
        ("pa", "p_supply", "p_a", 1),
        ("at", "p_a", "p_tank", -1),
        ("pb", "p_supply", "p_b", -1),
        ("bt", "p_b", "p_tank", 1),
    ]
    assert model.lag.nominal_s == pytest.approx(1.3e-3)
    assert model.edges[0].rated_q_m3s == pytest.approx(30 / 60000)
    assert model.edges[0].safe_band_v == 1.0
    assert model.signals[model.column("p_a")].noise == 5e3
    assert model.position == "x"


def test_example_takes_period_protection_and_resolution_from_the_dbc() -> None:
    project = load(EXAMPLE)
    message = project.assembly.messages[0]
    assert (message.period_s, message.counter, message.crc) == (1e-3, "AliveCounter", "Crc")
    assert message.data_id == 4640
    assert project.model.signals[1].resolution == pytest.approx(1e7 / 65535)
    assert project.assembly.mode == "cycle"
    assert project.assembly.signals[0].command and project.assembly.signals[0].hold == "zero"
    assert project.table_assembly is not None
    assert project.table_assembly.signals[1].signal == "p_A"


def test_late_rows_are_of_a_table(raw: dict[str, Any], tmp_path: Path) -> None:
    raw["signals"]["u"]["late_rows"] = 1
    project = loaded(raw, tmp_path)
    assert project.table_assembly is not None
    assemblies = project.assembly, project.table_assembly
    assert [assembly.signals[0].late_rows for assembly in assemblies] == [0, 1]
    del raw["signals"]["u"]["column"]
    assert "offset_ms" in refused(raw, tmp_path)["signals.u.late_rows"].remedy


def test_grids_merge_pieces_and_increase() -> None:
    grid = load(EXAMPLE).model.edges[0].grid
    assert grid.dp_pa[[0, 6, 7, -1]].tolist() == pytest.approx([0.0, 2e6, 3e6, 8e6])
    assert (np.diff(grid.dp_pa) > 0).all()
    assert grid.dp_pa[1] == pytest.approx(1e5)


def test_digest_follows_the_model_and_nothing_else(raw: dict[str, Any], tmp_path: Path) -> None:
    before = load(EXAMPLE).digest
    raw["record"]["validation_s"] = [90, 110]
    assert loaded(raw, tmp_path).digest == before
    raw["chambers"]["a"]["dead_volume_l"] = 0.61
    assert loaded(raw, tmp_path).digest != before


def with_modes(raw: dict[str, Any]) -> dict[str, Any]:
    """The example with a mode in the status message, and regeneration by the cross-port valve."""
    raw["signals"]["mode"] = {
        "message": "Motion",
        "signal": "Mode",
        "column": "mode",
        "unit": "mode",
        "numbers": {"extend": 1, "retract": 2, "regenerate": 3},
    }
    raw["edges"]["ab"] = {"source": "p_b", "sink": "p_a", "direction": 1}
    raw["modes"]["regenerate"] = ["pa", "ab"]
    return raw


def test_modes_tell_which_edges_may_open(raw: dict[str, Any], tmp_path: Path) -> None:
    model = loaded(with_modes(raw), tmp_path).model
    assert model.mode == "mode"
    opens = {edge.name: edge.modes for edge in model.edges}
    assert opens == {"pa": (1, 3), "at": (2,), "pb": (2,), "bt": (1,), "ab": (3,)}
    assert model.signals[model.column("mode")].kind == "mode"
    build(model)


def test_without_a_mode_signal_edges_are_free(raw: dict[str, Any], tmp_path: Path) -> None:
    assert all(edge.modes == () for edge in loaded(raw, tmp_path).model.edges)


def test_modes_need_their_numbers_and_every_edge(raw: dict[str, Any], tmp_path: Path) -> None:
    with_modes(raw)
    del raw["signals"]["mode"]["numbers"]["retract"]
    del raw["modes"]["regenerate"]
    problems = refused(raw, tmp_path)
    assert "extend = 1, retract = 2" in problems["signals.mode.numbers"].remedy
    assert "[modes]" in problems["edges.ab"].remedy


def test_upkeep_basis_and_form_reach_the_model(raw: dict[str, Any], tmp_path: Path) -> None:
    raw["upkeep"] = {"every_s": 10, "forget_min": 10, "innovation_sd": 8, "folds": 5}
    assert "upkeep.forget_min" in refused(raw, tmp_path)
    raw["upkeep"] = {"every_s": 10, "forget_s": 600, "folds": 5}
    raw["edge_defaults"]["basis"] = "blended"
    raw["edges"]["at"]["terms"] = "drop"
    raw["edges"]["at"]["basis"] = "taylor"
    raw["estimator"]["form"] = "restart"
    raw["gates"]["recovery_ms"] = 200
    model = loaded(raw, tmp_path).model
    assert (model.upkeep.forget_s, model.upkeep.folds, model.form) == (600.0, 5, "restart")
    assert model.upkeep.shared_forget_s == np.inf
    assert [e.basis for e in model.edges] == ["blended", "taylor", "blended", "blended"]
    assert model.edges[1].terms == "drop"
    assert model.gates.recovery_s == pytest.approx(0.2)


def set_at(raw: dict[str, Any], path: str, value: Any) -> None:
    *parents, last = path.split(".")
    for key in parents:
        raw = raw[key]
    if value is None:
        del raw[last]
    else:
        raw[last] = value


PA = {"source": "p_supply", "sink": "p_a", "direction": 1}

# One broken file per row: what to write where, which path the error names, words of the remedy.
BROKEN = [
    ("chambers.a.aera_cm2", 3, "chambers.a.aera_cm2", "area_cm2"),
    ("chambers.a.area_cm2", -1, "chambers.a.area_cm2", "number and unit"),
    ("chambers.a.area_cm2", None, "chambers.a.area", "piston_diameter"),
    ("chambers.a.piston_diameter_mm", 50, "chambers.a.area_cm2", "either"),
    ("chambers.a.area_bar", 3, "chambers.a.area_bar", "area_cm2"),
    ("chambers.a.dead_volume", 0.6, "chambers.a.dead_volume", "dead_volume_l"),
    ("chambers.a.dead_volume_cm3", 600, "chambers.a.dead_volume_cm3", "keep one"),
    ("chambers.a.sign", 2, "chambers.a.sign", "sign = 1"),
    ("chambers.a.sign", None, "chambers.a.sign", "grows with x"),
    ("chambers.a.pressure", "p_c", "chambers.a.pressure", "p_"),
    ("edges.pa.source", "u", "edges.pa.source", "p_"),
    ("edges.pa.sink", "p_x", "edges.pa.sink", "p_"),
    ("edges.pa.sink", "p_supply", "edges.pa.sink", "other side"),
    ("edges.pa.sink", "p_tank", "edges.pa", "p_a, p_b"),
    ("edges.pa.direction", 0, "edges.pa.direction", "direction = 1"),
    ("edges.pa.command", "p_a", "edges.pa.command", "u"),
    ("edges.pa.dp_grid_mpa", [0, 1, 2, 1.5], "edges.pa.dp_grid_mpa[3]", "low to high"),
    ("edges.pa.dp_grid_v", [0, 1], "edges.pa.dp_grid_v", "dp_grid_mpa"),
    ("edges.pa.u_grid_a", [0, 1], "edges.pa.u_grid_a", "u_grid_v"),
    ("edges.pa.u_grid_v", [{"start": 0, "stop": 1}], "edges.pa.u_grid_v[0]", "step"),
    ("edges.pa.u_grid_v", [{"start": 0, "stop": 1, "step": 0.3}], "edges.pa.u_grid_v[0]", "step"),
    ("edges.pa.reference_map", "no.csv", "edges.pa.reference_map", "existing"),
    ("edge_defaults.rated_flow_lpm", None, "edges.pa.rated_flow", "rated_flow_lpm = 30"),
    ("signals.p_a.unit", "barr", "signals.p_a.unit", "'bar'"),
    ("signals.p_a.unit", "bar", "signals.p_a.unit", "'Pa'"),  # against the DBC
    ("signals.p_a.unit", "mm", "signals.p_a.unit", "'Pa'"),
    ("signals.p_a.message", "Pressure", "signals.p_a.message", "'Pressures'"),
    ("signals.p_a.signal", "PAA", "signals.p_a.signal", "'PA'"),
    ("signals.p_a.message", None, "signals.p_a.message", "constant"),
    ("signals.p_a.noise", "guess", "signals.p_a.noise", "correct"),
    ("signals.x.range", [1, 0], "signals.x.range", "[low, high]"),
    ("signals.x", None, "signals", "position"),
    ("messages.Motoin", {"period_ms": 1}, "messages.Motoin", "'Motion'"),
    ("messages.Motion.counter", "Alive", "messages.Motion.counter", "AliveCounter"),
    ("messages.Motion.period_bar", 1, "messages.Motion.period_bar", "period_ms"),
    ("edge_defaults.rated_dp_mpa", 5e299, "edge_defaults.rated_dp_mpa", "number and unit"),
    ("signals.x.noise", 1e-200, "signals.x.noise", "number and unit"),
    (
        "edges.pa.u_grid_v",
        [{"start": [1], "stop": 2, "step": 1}],
        "edges.pa.u_grid_v[0]",
        "list the borders",
    ),
    ("edges.pa.u_grid_v", [{"start": "1", "stop": 2, "step": 1}], "edges.pa.u_grid_v[0]", "list"),
    ("upkeep", {"innovation_sd": 8}, "upkeep.innovation_sd", "every_s = 10"),
    ("filter.damping", 1.5, "filter.damping", "0.8"),
    ("estimator.recent_blocks", 2, "estimator.recent_blocks", "64"),
    ("edges.pa", PA | {"basis": "lapped", "terms": "command"}, "edges.pa", "taylor"),
    ("beta.bounds_mpa", [1600, 200], "beta.bounds_mpa", "[low, high]"),
    ("beta.nominal_mpa", 8, "beta", "around"),
    ("modes.extend", ["pa", "bb"], "modes.extend[1]", "there"),
    ("geometry.stroke_mm", None, "geometry.stroke_mm", "stroke_mm"),
    ("geometry.position", "v", "geometry.position", "x"),
    ("source.dbc", "none.dbc", "source.dbc", "relative"),
    ("source.mode", "sync", "source.mode", "choose"),
    ("source.time_unit", "bar", "source.time_unit", "ms"),
    ("estimator.form", "integra", "estimator.form", "choose"),
    ("dynamics.spool_lag.nominal_ms", -1, "dynamics.spool_lag.nominal_ms", "number"),
    ("fliter", {"damping": 1}, "fliter", "'filter'"),
    ("project", None, "project", "[project]"),
    ("gates.hysteresis", "5 %", "gates.hysteresis", "without quotes"),
]


@pytest.mark.parametrize("place,value,path,remedy", BROKEN, ids=lambda v: str(v)[:40])
def test_broken_file_is_refused_with_place_and_remedy(
    raw: dict[str, Any], tmp_path: Path, place: str, value: Any, path: str, remedy: str
) -> None:
    set_at(raw, place, value)
    problems = refused(raw, tmp_path)
    assert path in problems, problems
    assert remedy in str(problems[path])


def test_all_errors_are_named_at_once(raw: dict[str, Any], tmp_path: Path) -> None:
    set_at(raw, "chambers.a.area_cm2", -1)
    set_at(raw, "chambers.a.pressure", "p_c")  # in the same section as another error
    set_at(raw, "edges.bt.dp_grid_mpa", [0, 2, 1])
    set_at(raw, "signals.p_b.colour", "red")
    set_at(raw, "signals.p_b.signal", "PC")
    set_at(raw, "beta.bounds_mpa", [1600, 200])
    assert set(refused(raw, tmp_path)) == {
        "chambers.a.area_cm2",
        "chambers.a.pressure",
        "edges.bt.dp_grid_mpa[2]",
        "signals.p_b.colour",
        "signals.p_b.signal",
        "beta.bounds_mpa",
    }


@pytest.mark.parametrize("text", ["[project", "a = nope", "\x00", "[[signals]]\nx = 1", "x = 1"])
def test_text_that_is_no_project_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "project.toml"
    path.write_text(text)
    with pytest.raises(ProjectError):
        load(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ProjectError, match="TOML"):
        load(path)
    with pytest.raises(ProjectError, match="rtid init"):
        load(tmp_path / "none.toml")


@pytest.mark.parametrize("junk", [3, "x", [], {}, True, [1, "a"], {"a": {"b": 1}}, float("nan")])
def test_junk_in_any_section_is_refused_not_crashed_on(
    raw: dict[str, Any], tmp_path: Path, junk: Any
) -> None:
    for section in raw:
        broken = {**raw, section: junk}
        try:
            loaded(broken, tmp_path)
        except ProjectError as error:
            assert error.problems


@pytest.mark.parametrize("junk", [3, "x", {}, [1, "a"], float("nan")])
def test_junk_in_any_key_is_refused_not_crashed_on(
    raw: dict[str, Any], tmp_path: Path, junk: Any
) -> None:
    path = tmp_path / "project.toml"
    texts = {section: tomlkit.dumps({section: table}) for section, table in raw.items()}
    for section, table in raw.items():
        for key, value in table.items():
            inner = value if isinstance(value, dict) else {None: 0}
            for deep in inner:
                broken = deepcopy(table)
                if deep is None:
                    broken[key] = junk
                else:
                    broken[key][deep] = junk
                text = tomlkit.dumps({section: broken})  # of all of them it takes most of the time
                path.write_text("\n".join({**texts, section: text}.values()))
                try:
                    load(path)
                except ProjectError as error:
                    assert error.problems


def table_project(raw: dict[str, Any]) -> dict[str, Any]:
    """The example without CAN: signals are columns."""
    raw["source"] = {"time_column": "t"}
    del raw["messages"]
    for signal in raw["signals"].values():
        del signal["message"], signal["signal"]
    return raw


def test_units_become_si(raw: dict[str, Any], tmp_path: Path) -> None:
    raw = table_project(raw)
    raw["signals"]["p_a"] |= {"unit": "bar", "noise": 0.05, "range": [0, 250], "resolution": 0.1}
    raw["signals"]["x"] |= {"unit": "mm", "noise": "estimate", "range": [0, 500], "scale": -1.0}
    raw["signals"]["x"]["offset"] = 500.0
    raw["signals"]["p_tank"] = {"unit": "bar", "constant": 1}
    project = loaded(raw, tmp_path)
    p_a, x = (project.model.signals[project.model.column(name)] for name in ("p_a", "x"))
    assert [p_a.noise, p_a.maximum, p_a.resolution] == pytest.approx([5e3, 250e5, 1e4])
    assert [x.noise, x.maximum] == pytest.approx([0.0, 0.5])
    assert project.noise_unknown == ("x",)
    sources = {source.name: source for source in project.assembly.signals}
    assert (sources["x"].factor, sources["x"].offset) == (-1e-3, 0.5)
    assert sources["p_tank"].constant == 1e5
    assert project.model_with({"x": 1e-5}).signals[5].noise == 1e-5


def test_angle_becomes_position_through_its_table(raw: dict[str, Any], tmp_path: Path) -> None:
    raw = table_project(raw)
    raw["signals"]["x"] = {"column": "phi", "unit": "deg", "range": [-10, 40], "noise": 0.1}
    assert "signals.x.table" in refused(raw, tmp_path)
    raw["signals"]["x"]["table"] = {"angle": [-30, 0, 45], "position_mm": [0, 210, 500]}
    project = loaded(raw, tmp_path)
    source = project.assembly.signals[5]
    assert source.table == ((-30.0, 0.0, 45.0), (0.0, 0.21, 0.5))
    assert project.model.signals[5].minimum == pytest.approx(0.14)
    raw["signals"]["x"]["table"]["angle"] = [-30, -40, 45]
    assert "signals.x.table.angle[1]" in refused(raw, tmp_path)


def test_loose_messages_make_a_multirate_assembly(raw: dict[str, Any], tmp_path: Path) -> None:
    del raw["source"]["mode"], raw["gates"]["max_gap_ms"]
    raw["messages"]["Pressures"] = {"period_ms": 5}
    raw["messages"]["Motion"] = {"period_ms": 40, "offset_ms": "estimate", "tolerance_ms": 3}
    project = loaded(raw, tmp_path)
    assert project.assembly.mode == "multirate"
    assert project.offset_tolerance_s == {"Motion": pytest.approx(3e-3)}
    assert project.model.pressure_period_s == pytest.approx(5e-3)
    assert project.assembly.max_gap_s == pytest.approx(0.1)  # 2.5 periods of the slowest


def test_every_unit_is_found_by_its_name() -> None:
    for unit in UNITS:
        assert find_unit(unit.name) == unit
    assert find_unit("mA") != find_unit("A") and find_unit("MPA") == find_unit("MPa")
    assert find_unit("furlong") is None
