"""The catalogue of effects: complete, in one set of units, and honest about what looks alike."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

from rtid.cli.exits import Exit
from rtid.effects import Effect, EffectError, Expression, catalogue, effect
from rtid.effects.dimension import (
    FLOW,
    UNITS,
    Dimension,
    dimension,
    dimension_of_unit,
    unit_of_dimension,
)
from rtid.effects.page import KINDS, PLACES, pages_in
from rtid.effects.parsing import ExpressionError
from tests.command import ends, said

TWELVE = {
    *("internal_leakage_laminar", "external_leakage_laminar", "valve_seat_leakage"),
    *("entrained_air", "extra_dead_volume", "line_dynamics", "spool_lag_second_order"),
    *("input_delay", "valve_hysteresis", "supply_sag", "relief_valve", "valve_gain_drift"),
}
REST = {
    *("internal_leakage_turbulent", "external_leakage_turbulent", "hose_compliance"),
    *("spool_lag_first_order", "spool_rate_limit", "deadband_shift", "makeup_valve", "cavitation"),
    *("pressure_sensor_lag", "pressure_sensor_bias", "position_sensor_delay", "velocity_scale"),
    *("position_dependent_leakage", "load_compensated_valve"),
}
GENERIC = {
    *("coulomb_friction", "viscous_friction", "stribeck_friction", "backlash", "saturation"),
    *("overflow", "offset", "cubic_stiffness", "dead_zone", "pure_delay", "first_order_lag"),
    *("heat_loss", "linear_outflow"),
}
INVISIBLE = {
    *("valve_seat_leakage", "deadband_shift", "load_compensated_valve"),
    *("pressure_sensor_bias", "velocity_scale"),
}
SIGNALS = {"u", "x", "v", "t", "p_a", "p_b", "p_c", "p_supply", "p_tank", "state", "input", "port"}
SIGNALS |= {"v_y", "press"}
FLOWS = {"q_a", "q_b", "q_c", "q_e"}


def test_every_effect_of_the_contract_has_its_page() -> None:
    assert set(catalogue()) >= TWELVE | REST | GENERIC
    assert {name for name, e in catalogue().items() if e.invisible} >= INVISIBLE
    assert all(catalogue()[name].kind in ("mechanical", "generic") for name in GENERIC)


@pytest.mark.parametrize("page", catalogue().values(), ids=lambda e: e.name)
def test_page_is_complete(page: Effect) -> None:
    assert page.kind in KINDS and page.places and set(page.places) <= set(PLACES)
    assert page.signals and set(page.signals) <= SIGNALS
    for text in (page.summary, page.signature, page.separates, page.visible_when):
        assert len(text) > 40 and text.endswith(".") and "\n" not in text
    assert any(year in page.reference for year in ("19", "20", "ISO"))
    assert page.invisible == (page.kind == "map")
    assert all(symbol.unit and symbol.meaning for symbol in page.symbols), page.symbols
    assert page.parameters
    for parameter in page.parameters:
        assert all(parameter.low <= v <= parameter.high for v in parameter.start if v)
        assert parameter.low < parameter.high and parameter.meaning
        assert parameter.sign in (1, 0, -1)
        assert (parameter.low >= 0) == (parameter.sign == 1)
        dimension_of_unit(parameter.unit)
        assert any(parameter.symbol in line for line in page.equation)


def test_a_page_that_lacks_something_says_what(tmp_path: Path) -> None:
    page = tmp_path / "worn_end.toml"
    page.write_text('title = "Worn end"\nequation = ["q_c = -C * p_c"]\nparameters = []\n')
    with pytest.raises(EffectError, match=r"worn_end\.toml cannot be read: it lacks kind, ref"):
        list(pages_in(tmp_path))
    page.write_text("title = 3 4")
    with pytest.raises(EffectError, match="cannot be read"):
        list(pages_in(tmp_path))


@pytest.mark.parametrize("page", catalogue().values(), ids=lambda e: e.name)
def test_confounders_exist_and_are_mutual(page: Effect) -> None:
    assert page.confounders and page.name not in page.confounders
    for name in page.confounders:
        assert page.name in effect(name).confounders, f"{name} does not name {page.name}"


class Plain(ast.NodeTransformer):
    """The notations of an equation as plain arithmetic of the same dimension."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        assert isinstance(node.func, ast.Name)
        args = [ast.unparse(arg) for arg in node.args]
        plain = {
            "ddt": "({0}) / second",
            "delay": "({0}) * ({1}) / second",
            "lag": "({0}) * ({1}) / second",
            "play": "({0}) + ({1})",
            "Q": "Q * (({0}) / volt) * (({1}) / pascal)",
        }
        if node.func.id not in plain:
            return node
        return ast.parse(plain[node.func.id].format(*args), mode="eval").body


def side(text: str, known: dict[str, Dimension]) -> Dimension | None:
    plain = ast.unparse(Plain().visit(ast.parse(text, mode="eval")))
    return dimension(Expression.parse(plain, known), known)


@pytest.mark.parametrize("page", catalogue().values(), ids=lambda e: e.name)
def test_equations_agree_in_their_units(page: Effect) -> None:
    known = {s.name: dimension_of_unit(s.unit) for s in page.symbols}
    known |= {p.symbol: dimension_of_unit(p.unit) for p in page.parameters}
    known |= {"second": UNITS["s"], "volt": UNITS["V"], "pascal": UNITS["Pa"]}
    for line in page.equation:
        left, right = line.split(" = ")
        assert side(left, known) == side(right, known), line
        if left in FLOWS:
            assert side(right, known) == FLOW
    if page.kind in ("flow", "storage"):
        assert page.equation[-1].split(" = ")[0] in FLOWS


@pytest.mark.parametrize(
    ("name", "values", "q_a"),
    [
        ("internal_leakage_laminar", {"C_il": 6e-12, "p_a": 5e6, "p_b": 3e6}, -1.2e-5),
        ("external_leakage_laminar", {"C_el": 2e-12, "p_c": 4.1e6, "p_tank": 1e5}, -8e-6),
        ("internal_leakage_turbulent", {"K_it": 1e-9, "p_a": 1e6, "p_b": 5e6}, 2e-6),
        ("relief_valve", {"K_r": 1e-9, "p_c": 4e6, "p_r": 3.6e6}, -4e-4),
        ("relief_valve", {"K_r": 1e-9, "p_c": 3e6, "p_r": 3.6e6}, 0.0),
        ("makeup_valve", {"K_m": 1e-9, "p_c": 1e5, "p_m": 3e5}, 2e-4),
        ("position_dependent_leakage",
         {"C_x": 4e-12, "x": 0.2, "x_0": 0.25, "w_x": 0.1, "p_a": 2e6, "p_b": 0.0}, -4e-6),
    ],
)  # fmt: skip
def test_positive_coefficients_flow_the_physical_way(
    name: str, values: dict[str, float], q_a: float
) -> None:
    """A leak leaves the chamber of higher pressure; a make-up valve feeds it."""
    right = effect(name).equation[0].split(" = ")[1]
    assert Expression.parse(right)(**values) == pytest.approx(q_a, abs=1e-20)


@pytest.mark.parametrize(
    ("unit", "same"),
    [
        ("m3/s/Pa", "m3/(s Pa)"),
        ("Pa s/m3", "kg/m4/s"),
        ("m3/s/sqrt(Pa)", "m3/s/Pa**0.5"),
        ("N s/m", "kg/s"),
        ("W", "N m/s"),
        ("rad/s", "Hz"),
    ],
)
def test_units_are_read_as_an_engineer_writes_them(unit: str, same: str) -> None:
    assert dimension_of_unit(unit) == dimension_of_unit(same)


@pytest.mark.parametrize("unit", ["L/min", "MPa", "m3/s/", "", "__import__('os')"])
def test_other_units_are_refused(unit: str) -> None:
    with pytest.raises(ExpressionError):
        dimension_of_unit(unit)


def test_dimensions_are_written_as_units() -> None:
    assert unit_of_dimension(dimension_of_unit("m3/s")) == "m3/s"
    assert unit_of_dimension(dimension_of_unit("1")) == "1"
    assert dimension_of_unit(unit_of_dimension(UNITS["W"])) == UNITS["W"]


def test_a_wrong_name_names_the_near_one() -> None:
    with pytest.raises(EffectError) as caught:
        effect("internal_leakage_lamina")
    assert "internal_leakage_laminar" in caught.value.remedy
    with pytest.raises(EffectError) as caught:
        effect("leakage")
    assert "position_dependent_leakage or valve_seat_leakage" in caught.value.remedy


def test_command_lists_all_effects() -> None:
    code, out, _ = said("effects")
    assert code == Exit.OK
    assert all(name in out for name in catalogue())
    assert max(len(line) for line in out.splitlines()) <= 100
    code, out, _ = said("effects", "--json")
    assert [e["name"] for e in json.loads(out)["effects"]] == list(catalogue())


@pytest.mark.parametrize("name", list(catalogue()))
def test_command_shows_a_page_in_100_columns(name: str) -> None:
    code, out, _ = said("effects", name)
    page = effect(name)
    assert code == Exit.OK and page.title in out
    assert max(len(line) for line in out.splitlines()) <= 100
    told = " ".join(out.split())
    for word in (*page.confounders, *(p.name for p in page.parameters), page.signature.split()[0]):
        assert word in told
    assert "**" not in out and " * " not in out
    assert ("swallows" in told or "invisible" in told.lower()) or not page.invisible


def test_command_gives_a_page_as_json() -> None:
    _, out, _ = said("effects", "relief_valve", "--json")
    page = json.loads(out)
    assert page["parameters"][1]["unit"] == "Pa" and page["kind"] == "flow"
    assert page["equation"][0] == "q_c = -K_r * pos(p_c - p_r)"


def test_command_refuses_an_unknown_effect(capsys: pytest.CaptureFixture[str]) -> None:
    assert ends("effects", "relief") == Exit.USAGE
    assert "relief_valve" in capsys.readouterr().err


def test_catalogue_needs_no_bus_and_no_kernel() -> None:
    code = (
        "import sys, rtid.effects\nrtid.effects.catalogue()\n"
        "print({'can', 'numba', 'scipy', 'pydantic'} & set(sys.modules) or '')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
