"""Effects in the project file: what they become, and that every error has its key path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit

import rtid.project
from rtid.effects import View
from rtid.effects.law import flow
from rtid.project import Problem, Project, ProjectError, load
from rtid.project.trust import trust

EXAMPLE = Path(rtid.project.__file__).parent / "examples" / "cylinder.toml"
GROOVE = """
[effects.worn_groove]
flow = "pos(x - x0) * (p_a - p_b)"        # m3/s per unit of the coefficient
chambers = {a = -1, b = 1}
unit = "m3/s/Pa/m"
sign = 1
largest = 1e-9
x0 = [0.1, 0.2, 0.3]
"""
PYTHON = """
import numpy as np
from rtid.effects import define

@define("m3/s/Pa", chambers={"a": -1}, p0=[3e6, 4e6])
def shock_valve(view, p0):
    '''Opens at p0.'''
    return np.maximum(view.p["p_a"] - p0, 0.0)
"""


def loaded(folder: Path, more: str, python: str = "") -> Project:
    text = EXAMPLE.read_text()
    if python:
        (folder / "mine.py").write_text(python)
        trust(folder / "mine.py")
        text = text.replace("[project]", '[project]\neffects_module = "mine.py"', 1)
    path = folder / "project.toml"
    path.write_text(text + more)
    return load(path)


def refused(folder: Path, more: str, python: str = "") -> dict[str, Problem]:
    with pytest.raises(ProjectError) as caught:
        loaded(folder, more, python)
    assert all(problem.remedy for problem in caught.value.problems)
    return {problem.path: problem for problem in caught.value.problems}


def changed(**keys: Any) -> str:
    """The groove with some keys replaced, None drops one."""
    table = tomlkit.parse(GROOVE)
    groove: Any = table["effects"]
    for key, value in keys.items():
        if value is None:
            del groove["worn_groove"][key]
        else:
            groove["worn_groove"][key] = value
    return "\n" + tomlkit.dumps(table)


def sample(project: Project) -> View:
    names = [signal.name for signal in project.model.signals]
    values = np.zeros((2, len(names)))
    values[:, names.index("x")] = 0.25
    values[:, names.index("p_a")] = 5e6
    values[:, names.index("p_b")] = 1e6
    return View(project.model, np.array([0.0, 0.001]), values)


def test_without_effects_there_are_none() -> None:
    assert load(EXAMPLE).effects == ()


def test_a_formula_becomes_an_effect(tmp_path: Path) -> None:
    project = loaded(tmp_path, GROOVE)
    (groove,) = project.effects
    assert (groove.name, groove.size.unit, groove.size.sign, groove.size.high) == (
        "worn_groove", "m3/s/Pa/m", 1, 1e-9,
    )  # fmt: skip
    assert groove.into == (("a", -1), ("b", 1))
    flows = [flow(groove, sample(project), {"x0": x0})[0] for x0 in groove.shapes[0].start]
    np.testing.assert_allclose(flows, [0.15 * 4e6, 0.05 * 4e6, 0.0])


def test_effects_do_not_change_the_digest_of_the_model(tmp_path: Path) -> None:
    assert loaded(tmp_path, GROOVE).digest == load(EXAMPLE).digest


def test_the_stroke_has_a_name(tmp_path: Path) -> None:
    project = loaded(tmp_path, changed(flow="pos(stroke - x0 - x) * (p_a - p_b)"))
    (groove,) = project.effects
    flows = [flow(groove, sample(project), {"x0": x0})[0] for x0 in groove.shapes[0].start]
    np.testing.assert_allclose(flows, [0.15 * 4e6, 0.05 * 4e6, 0.0])


def test_a_python_file_gives_effects_beside_the_formulas(tmp_path: Path) -> None:
    project = loaded(tmp_path, GROOVE, PYTHON + "alias = shock_valve\n")
    assert [effect.name for effect in project.effects] == ["worn_groove", "shock_valve"]
    valve = project.effects[1]
    assert valve.title == "Opens at p0." and valve.into == (("a", -1),)
    assert flow(valve, sample(project), {"p0": 4e6})[0] == pytest.approx(1e6)


@pytest.mark.parametrize(
    ("keys", "path", "problem", "remedy"),
    [
        ({"flow": "pos(x - x0) * (p_a - pb)"}, "flow", "'pb' is no known name (column 22", "'p_b'"),
        ({"flow": "(x - x0) ^ 2 * p_a"}, "flow", "^ is no operator here (column", "power as **"),
        ({"flow": "x.__class__"}, "flow", "Attribute is not allowed", "use numbers"),
        ({"flow": "(x - x0) + p_a"}, "flow", "+ joins m and", "same unit"),
        ({"flow": None}, "flow", "missing", "flow ="),
        ({"flow": 3}, "flow", "valid string", "flow ="),
        ({"unit": "L/min"}, "unit", "no SI unit", "write it in"),
        ({"unit": "m3/s/Pa"}, "", "that is no m3/s", "unit ="),
        ({"unit": None}, "unit", "missing", "unit ="),
        ({"chambers": {"a": -1, "c": 1}}, "chambers.c", "no chamber 'c'", "a, b"),
        ({"chambers": {"a": 0}}, "chambers.a", "must be 1 or -1", "chambers ="),
        ({"chambers": {}}, "chambers", "at least 1", "chambers ="),
        ({"sign": 2}, "sign", "must be 1, 0 or -1", "choose"),
        ({"largest": 0}, "largest", "greater than 0", "check"),
        ({"x0": []}, "x0", "at least 1", "correct"),
        ({"x0": [0.1, "far"]}, "x0[1]", "valid number", "without quotes"),
        ({"x0": None}, "flow", "'x0' is no known name", "did you mean"),
        ({"x1": [1.0]}, "", "flow does not use 'x1'", "use it"),
        ({"shapes": {"x1": [1.0]}}, "shapes", "unknown key", "a key of its own"),
        ({"colour": "red"}, "colour", "unknown key", "choose one of"),
    ],
)
def test_each_error_is_named_by_key_path(
    tmp_path: Path, keys: dict[str, Any], path: str, problem: str, remedy: str
) -> None:
    problems = refused(tmp_path, changed(**keys))
    place = f"effects.worn_groove.{path}".rstrip(".")
    assert list(problems) == [place]
    assert problem in problems[place].problem
    assert remedy in problems[place].remedy


def test_all_errors_are_named_at_once(tmp_path: Path) -> None:
    more = changed(flow="pos(x - x0) * (p_a - pb)") + (
        '\n[effects.relief_valve]\nflow = "p_a"\nunit = "m3/s/Pa"\nchambers = {c = 1}\n'
    )
    problems = refused(tmp_path, more, PYTHON.replace('{"a": -1}', '{"z": -1}'))
    assert set(problems) >= {
        "effects.worn_groove.flow",
        "effects.relief_valve.chambers.c",
        "effects.relief_valve",
        "project.effects_module",
    }
    assert "catalogue" in problems["effects.relief_valve"].problem


@pytest.mark.parametrize(
    ("python", "problem"),
    [
        ("x = 1\n", "defines no effect"),
        ("import no_such_module\n", "line 1: ModuleNotFoundError"),
        ("\n\n1 / 0\n", "line 3: ZeroDivisionError"),
        ("def f(:\n", "line 1: SyntaxError"),
        ("import sys\nsys.exit(3)\n", "line 2: SystemExit"),
        (PYTHON.replace("m3/s/Pa", "gallons"), "'gallons' is no SI unit"),
    ],
)
def test_errors_of_the_python_file_name_its_line(tmp_path: Path, python: str, problem: str) -> None:
    assert problem in refused(tmp_path, "", python)["project.effects_module"].problem


def test_a_missing_python_file_and_a_double_name_are_refused(tmp_path: Path) -> None:
    text = EXAMPLE.read_text().replace("[project]", '[project]\neffects_module = "none.py"', 1)
    (tmp_path / "project.toml").write_text(text)
    with pytest.raises(ProjectError, match=r"none\.py is no file"):
        load(tmp_path / "project.toml")
    twice = refused(tmp_path, GROOVE, PYTHON.replace("shock_valve", "worn_groove"))
    assert "defined twice" in twice["project.effects_module"].problem
