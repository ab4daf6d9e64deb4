"""Effects of the user's own: one flow from a function and from a formula, and clear refusals."""

from __future__ import annotations

import numpy as np
import pytest

import rtid.effects
from rtid.effects import (
    Effect,
    EffectError,
    ExpressionError,
    View,
    catalogue,
    effect,
    from_expression,
    names_of_model,
)
from rtid.effects.law import Placed, flow, places_of
from rtid.effects.record_view import RecordView as Record
from rtid.model import COMMAND, POSITION, PRESSURE, VELOCITY, Chamber, Machine, Signal
from rtid.plain import FloatArray

MODEL = Machine(
    signals=(
        Signal("u", COMMAND, "V"),
        Signal("p_a", PRESSURE),
        Signal("p_b", PRESSURE),
        Signal("pos", POSITION),
    ),
    chambers=(Chamber("a", "p_a", 2e-3, 1, 6e-4), Chamber("b", "p_b", 1e-3, -1, 1.1e-3)),
    edges=(),
    position="pos",
    beta_nominal_pa=850e6,
    beta_bounds_pa=(200e6, 1600e6),
)
NAMES = names_of_model(MODEL)


def view(n: int = 200) -> View:
    t_s = np.arange(n, dtype=np.float64) * 1e-3
    rng = np.random.default_rng(1)
    p = rng.uniform(1e6, 7e6, (n, 2))
    return View(MODEL, t_s, np.column_stack([np.sin(t_s), p, 0.2 + 0.1 * np.sin(5 * t_s)]))


@rtid.effects.define("m3/s/Pa/m", chambers={"a": -1, "b": 1}, largest=1e-9, x0=[0.1, 0.2, 0.3])
def worn_groove(view: View, x0: float) -> FloatArray:
    """Leaks beyond x0."""
    return np.maximum(view.x - x0, 0.0) * (view.p["p_a"] - view.p["p_b"])


def record() -> Record:
    seen = view()
    return Record.without_map(MODEL, np.column_stack([seen.t_s, 0 * seen.t_s, seen.values]))


def placed(effect: Effect) -> Placed:
    (found,) = places_of(effect, MODEL, np.zeros(2))
    return found


def formula(flow: str, unit: str = "m3/s/Pa", **shapes: list[float]) -> Effect:
    chambers = {"a": -1, "b": 1}
    return from_expression("mine", flow, unit, names=NAMES, chambers=chambers, shapes=shapes)


def test_a_function_and_a_formula_give_the_same_flow() -> None:
    text = "pos(x - x0) * (p_a - p_b)"
    written = formula(text, "m3/s/Pa/m", x0=[0.1, 0.2, 0.3])
    assert worn_groove.name == "worn_groove" and worn_groove.title == "Leaks beyond x0."
    assert worn_groove.into == (("a", -1), ("b", 1)) == written.into
    for made in (worn_groove, written):
        (x0,) = made.shapes
        assert (x0.name, x0.start) == ("x0", (0.1, 0.2, 0.3))
        assert x0.low == pytest.approx(0.0) and x0.high == pytest.approx(0.4)
    assert written.shapes[0].unit == "m"
    for at in (0.1, 0.2, 0.3):
        found = flow(written, view(), {"x0": at})
        np.testing.assert_array_equal(found, flow(worn_groove, view(), {"x0": at}))
        for c, volume in placed(written).volumes(record(), (at,)).items():
            np.testing.assert_array_equal(volume, placed(worn_groove).volumes(record(), (at,))[c])
    assert flow(worn_groove, view(), {"x0": 0.2}).max() > 1e5


@pytest.mark.parametrize(
    ("chambers", "where"), [({"a": -1, "b": 1}, "a-b"), ({"b": 1}, "b"), ({"a": 1, "b": 1}, "both")]
)
def test_the_place_is_named_by_its_chambers(chambers: dict[str, int], where: str) -> None:
    made = from_expression("mine", "p_a - p_b", "m3/s/Pa", names=NAMES, chambers=chambers)
    assert [p.where for p in places_of(made, MODEL, np.zeros(2))] == [where]


def test_a_view_knows_what_an_effect_may_look_at() -> None:
    seen = view()
    np.testing.assert_allclose(seen.v[1:-1], 0.5 * np.cos(5 * seen.t_s[1:-1]), rtol=1e-4)
    np.testing.assert_allclose(seen.volume_m3["a"], 6e-4 + 2e-3 * seen.x)
    np.testing.assert_allclose(seen.volume_m3["b"], 1.1e-3 - 1e-3 * seen.x)
    assert seen.area_m2 == {"a": 2e-3, "b": 1e-3}
    np.testing.assert_allclose(seen.dt_s, 1e-3)
    np.testing.assert_array_equal(seen.u, seen.values[:, 0])
    assert list(seen.p) == ["p_a", "p_b"]
    for name in NAMES:
        assert seen.value(name).shape == seen.t_s.shape
    with pytest.raises(EffectError, match="no signal 'p_c'"):
        seen.signal("p_c")
    with pytest.raises(EffectError, match="no 'A_c'"):
        seen.value("A_c")


def test_a_measured_velocity_is_taken() -> None:
    signals = (Signal("pos", POSITION), Signal("w", VELOCITY, "m/s"))
    model = Machine(signals, (), (), "pos", 1.0, (0.5, 2.0))
    seen = View(model, np.arange(3.0), np.array([[0.0, 7.0], [0.0, 8.0], [0.0, 9.0]]))
    np.testing.assert_array_equal(seen.v, [7.0, 8.0, 9.0])
    with pytest.raises(EffectError, match="no command"):
        _ = seen.u


def test_volumes_hold_the_command_and_take_the_rest_as_linear() -> None:
    """Half a sample of wrong hold would look like a delay."""
    seen, found = view(), formula("u * (p_a - p_b)", "m3/s/Pa/V")
    u, drop = seen.u, seen.p["p_a"] - seen.p["p_b"]
    wanted = u[:-1] * 0.5 * (drop[1:] + drop[:-1]) * 1e-3
    volumes = placed(found).volumes(record(), ())
    np.testing.assert_allclose(volumes[0], -wanted, rtol=1e-9)
    np.testing.assert_allclose(volumes[1], wanted, rtol=1e-9)


def test_geometry_time_and_constants_have_names() -> None:
    chambers = {"a": 1}
    found = from_expression(
        "mine", "(stroke - x) * A_a * tanh(v / 0.1) / t_0 + V_a * 0 / t_0", "1",
        names=NAMES, constants={"stroke": 0.5, "t_0": 2.0}, chambers=chambers,
    )  # fmt: skip
    seen = view()
    wanted = (0.5 - seen.x) * 2e-3 * np.tanh(seen.v / 0.1) / 2
    np.testing.assert_allclose(flow(found, seen), wanted)


@pytest.mark.parametrize(
    ("flow", "unit", "remedy"),
    [
        ("p_a - p_b", "m3/s", "m4 s/kg"),
        ("ssqrt(p_a - p_b)", "m3/s/Pa", "sqrt"),
        ("x * u", "m3/s/V", "m2/s/V"),
    ],
)
def test_a_unit_that_gives_no_flow_is_refused_with_the_right_one(
    flow: str, unit: str, remedy: str
) -> None:
    with pytest.raises(EffectError, match="no m3/s") as caught:
        formula(flow, unit)
    assert remedy in caught.value.remedy
    right = caught.value.remedy.split("'")[1]
    assert formula(flow, right).size.unit == right


@pytest.mark.parametrize("flow", ["pos(p_a - 3.6e6)", "min(p_a, 1e6)", "2 * p_a", "p_a / 3"])
def test_plain_numbers_take_the_unit_of_their_place(flow: str) -> None:
    assert f"({flow})" in formula(flow).equation[0]


@pytest.mark.parametrize("flow", ["p_a + x", "max(p_a, u)", "exp(x)", "p_a**x", "x - V_a"])
def test_units_that_clash_are_refused_with_the_place(flow: str) -> None:
    with pytest.raises(ExpressionError) as caught:
        formula(flow)
    assert "^" in str(caught.value)


def test_a_formula_that_is_not_finite_says_where() -> None:
    with pytest.raises(EffectError, match=r"not finite in 100 of 200 samples, the first at 0 s"):
        flow(formula("sqrt(t - 0.0995)", "m3/s/sqrt(s)"), view())


def test_a_function_that_fails_is_named_with_its_error() -> None:
    @rtid.effects.define("m3/s/Pa", chambers={"a": 1})
    def broken(view: View) -> FloatArray:
        return view.p["p_c"]

    with pytest.raises(EffectError, match="'broken' fails: KeyError: 'p_c'"):
        flow(broken, view())

    @rtid.effects.define("m3/s/Pa", chambers={"a": 1})
    def short(view: View) -> FloatArray:
        return view.x[:-1]

    with pytest.raises(EffectError, match="'short' fails: ValueError"):
        flow(short, view())


@pytest.mark.parametrize(
    ("keys", "wrong"),
    [
        ({"chambers": {}}, "chambers must give"),
        ({"chambers": {"a": 2}}, "chambers must give"),
        ({"chambers": {"a": 1}, "sign": 3}, "sign is 3"),
        ({"chambers": {"a": 1}, "largest": -1.0}, "largest is -1"),
        ({"chambers": {"a": 1}, "x0": []}, "x0 has no finite values"),
        ({"chambers": {"a": 1}, "x0": [float("nan")]}, "x0 has no finite values"),
        ({"chambers": {"a": 1}, "x0": range(9), "x1": range(9)}, "81 combinations"),
    ],
)
def test_definitions_that_cannot_be_are_refused(keys: dict[str, object], wrong: str) -> None:
    with pytest.raises(EffectError, match=wrong):
        rtid.effects.define("m3/s/Pa", **keys)(lambda view: view.x)  # type: ignore[arg-type]
    with pytest.raises(ExpressionError, match="no SI unit"):
        rtid.effects.define("L/min/MPa", chambers={"a": 1})(lambda view: view.x)


def test_a_shape_that_is_not_used_is_refused() -> None:
    with pytest.raises(EffectError, match="does not use 'x0'"):
        formula("p_a - p_b", x0=[0.1])


def test_a_catalogue_equation_is_a_users_formula_too() -> None:
    """The catalogue's internal leak, written by a user, is the same flow."""
    page = effect("internal_leakage_laminar")
    found = formula("p_a - p_b", page.parameters[0].unit)
    seen = view()
    np.testing.assert_array_equal(flow(found, seen), seen.p["p_a"] - seen.p["p_b"])
    (of_page,) = places_of(page, MODEL, np.zeros(2))
    for c, volume in placed(found).volumes(record(), ()).items():
        np.testing.assert_array_equal(of_page.volumes(record(), ())[c], volume)
    assert page.name in catalogue()
