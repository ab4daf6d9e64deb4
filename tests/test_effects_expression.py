"""Expressions are worth what Python says, and nothing but arithmetic gets through."""

from __future__ import annotations

import contextlib
import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtid.effects import Expression, ExpressionError
from rtid.effects.parsing import MOST_CHARACTERS, MOST_DEPTH
from rtid.effects.tree import FUNCTIONS, NAME, NEG, NUMBER, Node, written

NAMES = ("x", "p_a", "p_b", "c")


SCOPE: dict[str, Any] = {  # the same functions for Python's own evaluation, on numpy's arrays
    "ssqrt": lambda z: np.sign(z) * np.sqrt(abs(z)),
    "pos": lambda z: np.maximum(z, 0.0),
    "min": np.minimum,
    "max": np.maximum,
    "abs": abs,
} | {
    name: getattr(np, name)
    for name in ("sqrt", "sign", "exp", "log", "sin", "cos", "tanh", "hypot")
}


def by_python(text: str, values: dict[str, float], factor: float = 1.0) -> float:
    """What Python makes of the text, with every number in it times a factor."""
    numpys = re.sub(r"(?<![\w.])([\d.]+(e[+-]?\d+)?)", r"number(\1)", text)
    scope = SCOPE | {name: np.array([factor * value]) for name, value in values.items()}
    scope["number"] = lambda value: np.array([factor * float(value)])
    with np.errstate(all="ignore"):
        (found,) = eval(numpys, {"__builtins__": {}}, scope)
    return float(found)


def numbers() -> st.SearchStrategy[Node]:
    plain = st.integers(0, 9).map(float) | st.sampled_from([0.5, 1e-3, 2.75, 1e6])
    return plain.map(lambda v: Node(NUMBER, value=v))


def grown(inner: st.SearchStrategy[Node]) -> st.SearchStrategy[Node]:
    calls = [
        st.tuples(st.just(name), st.tuples(*[inner] * count))
        for name, (count, _) in FUNCTIONS.items()
    ]
    binary = st.tuples(st.sampled_from(["+", "-", "*", "/"]), st.tuples(inner, inner))
    exponents = st.sampled_from([0.0, 1.0, 2.0, 2.75, 8.0])  # (-inf)**0.5 is numpy's own affair
    power = st.tuples(
        st.just("**"), st.tuples(inner, exponents.map(lambda v: Node(NUMBER, value=v)))
    )
    negated = st.tuples(st.just(NEG), st.tuples(inner))
    return st.one_of(binary, power, negated, *calls).map(lambda made: Node(made[0], made[1]))


TREES = st.recursive(
    numbers() | st.sampled_from(NAMES).map(lambda name: Node(NAME, name=name)), grown, max_leaves=12
)
VALUES = st.fixed_dictionaries({name: st.floats(-1e3, 1e3) for name in NAMES})


@given(TREES, VALUES)
@settings(deadline=None, max_examples=400, suppress_health_check=[HealthCheck.too_slow])
def test_value_is_that_of_python(tree: Node, values: dict[str, float]) -> None:
    text = written(tree)
    if len(text) > MOST_CHARACTERS:
        return
    wanted, near = by_python(text, values), by_python(text, values, 1 + 1e-13)
    if not np.isclose(wanted, near, rtol=1e-9, atol=0.0, equal_nan=True):
        return  # the last digit of a function decides, such as in sin(exp(30))
    found = Expression.parse(text, NAMES)(**values)
    np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-300)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("ssqrt(p_a - p_b)", -math.sqrt(2e6)),
        ("pos(p_b - p_a) * x**2", 2e6 * 0.09),
        ("-x**2", -0.09),
        (
            "2**-x * exp(-x) + log(p_b) / sin(x)",
            2**-0.3 * math.exp(-0.3) + math.log(3e6) / math.sin(0.3),
        ),
        ("hypot(3, 4) - min(7, x, 2) + max(1, 2, 3)", 5 - 0.3 + 3),
        ("tanh(c) * cos(pi * c) - sign(-x) - abs(-c)", math.tanh(2.0) + 1 - 2.0),
        ("12 / 3 / 2 - 1 - 1", 0.0),
    ],
)
def test_values_known_by_hand(text: str, value: float) -> None:
    found = Expression.parse(text, NAMES)(x=0.3, p_a=1e6, p_b=3e6, c=2.0)
    assert found == pytest.approx(value, rel=1e-12)


@given(TREES)
@settings(deadline=None, max_examples=200)
def test_what_is_written_reads_back_as_the_same(tree: Node) -> None:
    text = written(tree)
    if len(text) <= MOST_CHARACTERS:
        assert Expression.parse(text, NAMES).root == tree


SMOOTH = ("exp(x / 900)", "sin(x) * cos(p_a)", "tanh(x / 7) / (3 + x**2)", "sqrt(4 + x**2)")
CORNERS = ("abs(x - 1)", "pos(x - p_a) * c", "min(x, p_a, 3 * c)", "max(x * c, p_b)", "ssqrt(x)")
OTHERS = ("log(x**2 + 1)**3", "-x**-2", "hypot(x, p_a) - c", "(x**2 + 1)**(x / 50)", "c / x", "p_a")


@pytest.mark.parametrize("text", [*SMOOTH, *CORNERS, *OTHERS])
@given(values=VALUES)
@settings(deadline=None, max_examples=60)
def test_derivative_is_the_slope(text: str, values: dict[str, float]) -> None:
    """Against central differences, away from corners and poles."""
    values = values | {"x": 0.25 + abs(values["x"]) / 20}
    expression = Expression.parse(text, NAMES)
    step = 1e-5

    def at(x: float) -> float:
        return float(expression(**(values | {"x": x})))

    left, middle, right = at(values["x"] - step), at(values["x"]), at(values["x"] + step)
    slope = (right - left) / (2 * step)
    scale = abs(middle) / values["x"] + abs(slope) + 1e-9
    if abs(right - 2 * middle + left) / step > 1e-3 * scale:
        return  # a corner
    found = float(expression.derivative("x")(**values))
    assert found == pytest.approx(slope, rel=1e-4, abs=1e-5 * scale + 1e-9 * abs(middle) / step)


def test_derivative_to_a_name_that_is_not_there_is_zero() -> None:
    expression = Expression.parse("p_a - p_b")
    assert str(expression.derivative("x")) == "0"
    assert str(expression.derivative("p_b")) == "-1"
    assert str(Expression.parse("c * x**3").derivative("x")) == "c * (3 * x**2)"
    assert str(Expression.parse("abs(x)").derivative("x")) == "sign(x)"


def test_arrays_broadcast_and_other_names_are_ignored() -> None:
    expression = Expression.parse("pos(x - x0) * (p_a - p_b)", ["x", "x0", "p_a", "p_b", "u"])
    assert expression.names == ("x", "x0", "p_a", "p_b")
    flow = expression(x=np.array([0.0, 0.2, 0.4]), x0=0.1, p_a=3e6, p_b=1e6, u=7)
    np.testing.assert_allclose(flow, [0.0, 2e5, 6e5])
    assert flow.dtype == np.float64


@pytest.mark.parametrize(
    ("text", "x", "value"),
    [
        ("1 / x", 0.0, np.inf),
        ("-1 / x", 0.0, -np.inf),
        ("x / x", 0.0, np.nan),
        ("sqrt(x)", -1.0, np.nan),
        ("ssqrt(x)", -4.0, -2.0),
        ("log(x)", 0.0, -np.inf),
        ("exp(x)", 1e4, np.inf),
        ("x**0.5", -1.0, np.nan),
        ("max(0, x)", np.nan, np.nan),
        ("pos(x)", np.nan, np.nan),
        ("sign(x)", np.nan, np.nan),
        ("tanh(x)", -np.inf, -1.0),
    ],
)
@pytest.mark.filterwarnings("error")
def test_values_that_are_not_finite_follow_ieee_and_stay_quiet(
    text: str, x: float, value: float
) -> None:
    found = Expression.parse(text)(x=np.array([x, 1.0]))
    np.testing.assert_equal(found[0], value)
    assert np.isfinite(found[1])


HOSTILE = [
    "__import__('os').system('true')",
    "().__class__.__bases__[0].__subclasses__()",
    "x.__class__",
    "x[0]",
    "(lambda: x)()",
    "[x for x in (1, 2)]",
    "{x: 1}",
    "f'{x}'",
    "'text' * 3",
    "b'text'",
    "x if x else p_a",
    "x and p_a",
    "x < p_a",
    "not x",
    "~x",
    "x // 2",
    "x % 2",
    "x @ x",
    "x << 9",
    "(y := 3)",
    "x, p_a",
    "await x",
    "yield x",
    "eval('x')",
    "open('x')",
    "sqrt(x, x)",
    "min(x)",
    "hypot(x)",
    "sqrt(*x)",
    "sqrt(x=x)",
    "sqrt",
    "True",
    "None",
    "...",
    "1j",
    "x; p_a",
    "x = 1",
    "import os",
    "x # p_a",
    "x\x00",
    "x + ﬀ",
    "p_ａ",
    "x**9",
    "x**-9",
    "9" * 400,
    "1e999",
    "(" * 300 + "x" + ")" * 300,
    "-" * 900 + "x",
    "x" + "+x" * 300,
    "x" * 5000,
    "x +",
    "",
    "   ",
    "exec",
    "__builtins__",
    "nan",
    "inf",
]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_everything_but_arithmetic_is_refused_with_its_place(text: str) -> None:
    with pytest.raises(ExpressionError) as caught:
        Expression.parse(text, NAMES)
    error = caught.value
    assert error.remedy and error.exit_code == 2
    lines = str(error).splitlines()
    assert lines[-1].strip() == "^" and len(lines[-1]) == error.column + 3
    assert "column" in error.in_one_line


@given(st.text(max_size=60) | st.text("xp_ab()+-*/.,0123456789e sqrtminos", max_size=40))
@settings(deadline=None, max_examples=400)
@pytest.mark.filterwarnings("error")
def test_any_text_is_read_or_refused(text: str) -> None:
    with contextlib.suppress(ExpressionError):
        Expression.parse(text, NAMES)(x=1.0, p_a=2.0, p_b=3.0, c=4.0)


def test_the_error_points_at_the_place_and_names_the_near_one() -> None:
    with pytest.raises(ExpressionError) as caught:
        Expression.parse("pos(x) * (p_a - pb)", NAMES)
    assert str(caught.value) == (
        "'pb' is no known name\n  pos(x) * (p_a - pb)\n                  ^"
    )
    assert caught.value.remedy == "did you mean 'p_b'?"
    with pytest.raises(ExpressionError) as caught:
        Expression.parse("sqr(x)", NAMES)
    assert caught.value.remedy == "did you mean 'sqrt'?"


def test_a_missing_value_is_named() -> None:
    with pytest.raises(ExpressionError, match="'p_a' has no value"):
        Expression.parse("x * p_a")(x=1.0)


def test_depth_is_limited_but_long_sums_within_it_work() -> None:
    text = "+".join(["x"] * (MOST_DEPTH - 2))
    assert Expression.parse(text)(x=1.0) == MOST_DEPTH - 2


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("depth", [10, MOST_DEPTH - 2, 400])
def test_a_deep_or_long_formula_of_any_function_is_read_or_refused(name: str, depth: int) -> None:
    """None ends in a RecursionError: not read, not evaluated, not derived, not written."""
    more = ", x" * (FUNCTIONS[name][0] - 1)
    texts = [f"{name}(" * depth + "x" + f"{more})" * depth]
    if name in ("min", "max"):
        texts.append(f"{name}({', '.join(['x'] * depth)})")
    for text in texts:
        with contextlib.suppress(ExpressionError):
            read = Expression.parse(text, ["x"])
            assert np.shape(read.value({"x": np.full(3, 0.5)})) == (3,)
            slope = read.derivative("x")
            assert np.size(slope.value({"x": np.full(3, 0.5)})) in (1, 3)
            assert str(slope) and str(read)


def test_the_largest_of_four_hundred_is_found() -> None:
    letters = "abcdefghij"
    read = Expression.parse(f"max({','.join(letters[k % 10] for k in range(400))})")
    values = {name: float(k) for k, name in enumerate(letters)}
    assert float(read.value(values)) == 9.0
    few = Expression.parse("max(a, b, c, d, e)")
    assert Expression.parse(str(few)).root == few.root
