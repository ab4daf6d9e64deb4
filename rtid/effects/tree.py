"""The tree of an arithmetic expression: what it is worth, what its slope is, how it is written.

A node is a number, a name, an operator (+ - * / ** and neg) or one of the functions below, with
ssqrt(z) = sign(z) sqrt|z| (a turbulent gap) and pos(z) = max(0, z) (a valve that opens at z = 0).

    d(a b) = a' b + a b'        d(a / b) = (a' - (a / b) b') / b
    d a**b = b a**(b - 1) a'    for a constant b, else a**b (b' log a + b a' / a)

At a corner (abs, sign, pos, min, max) the derivative is the mean of both sides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from rtid.plain import FloatArray

NUMBER, NAME, NEG = "number", "name", "neg"


@dataclass(frozen=True)
class Node:
    """One node; `column` is its place in the text that it was read from.

    names: those in the tree, in the order of their first appearance.
    """

    op: str
    args: tuple[Node, ...] = ()
    value: float = 0.0
    name: str = ""
    column: int = field(default=0, compare=False)
    names: tuple[str, ...] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        """Note the names in the tree: a deep one is not gone through again."""
        if self.op == NAME:
            names = [self.name]
        else:
            names = [name for arg in self.args for name in arg.names]
        object.__setattr__(self, "names", tuple(dict.fromkeys(names)))


def _ssqrt(z: FloatArray) -> FloatArray:
    return np.sign(z) * np.sqrt(np.abs(z))


def _pos(z: FloatArray) -> FloatArray:
    return np.maximum(z, 0.0)


OPERATORS: dict[str, Callable[..., FloatArray]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    "**": np.power,
    NEG: np.negative,
}
FUNCTIONS: dict[str, tuple[int, Callable[..., FloatArray]]] = {  # number of arguments, value
    "sqrt": (1, np.sqrt),
    "ssqrt": (1, _ssqrt),
    "abs": (1, np.abs),
    "sign": (1, np.sign),
    "pos": (1, _pos),
    "exp": (1, np.exp),
    "log": (1, np.log),
    "sin": (1, np.sin),
    "cos": (1, np.cos),
    "tanh": (1, np.tanh),
    "min": (2, np.minimum),
    "max": (2, np.maximum),
    "hypot": (2, np.hypot),
}


def evaluate(node: Node, values: Mapping[str, FloatArray]) -> FloatArray:
    """Value (...) of the tree, every name replaced by its array, any unit; IEEE, no exception."""
    if node.op == NUMBER:
        return np.asarray(node.value)
    if node.op == NAME:
        return values[node.name]
    function = OPERATORS.get(node.op) or FUNCTIONS[node.op][1]
    return function(*(evaluate(arg, values) for arg in node.args))


def number(value: float) -> Node:
    """A number as it would be read: a negative one is the negation of its size."""
    return Node(NEG, (Node(NUMBER, value=-value),)) if value < 0 else Node(NUMBER, value=value)


ZERO, ONE, TWO, HALF = number(0.0), number(1.0), number(2.0), number(0.5)


def _add(a: Node, b: Node) -> Node:
    if ZERO in (a, b):
        return a if b == ZERO else b
    return Node("+", (a, b))


def _sub(a: Node, b: Node) -> Node:
    if b == ZERO:
        return a
    return Node(NEG, (b,)) if a == ZERO else Node("-", (a, b))


def _mul(a: Node, b: Node) -> Node:
    if ZERO in (a, b):
        return ZERO
    if ONE in (a, b):
        return a if b == ONE else b
    return Node("*", (a, b))


def _div(a: Node, b: Node) -> Node:
    return ZERO if a == ZERO else Node("/", (a, b))


def _call(function: str, *args: Node) -> Node:
    return Node(function, args)


def derivative(node: Node, name: str) -> Node:
    """The tree of d node / d name."""
    if name not in node.names:
        return ZERO
    if node.op == NAME:
        return ONE
    slopes = [derivative(arg, name) for arg in node.args]
    if node.op in OPERATORS:
        return _operator_slope(node, *slopes)
    if len(node.args) == 1:
        return _mul(_outer_slope(node), slopes[0])
    return _pair_slope(node, *slopes)


def _operator_slope(node: Node, da: Node, db: Node = ZERO) -> Node:
    a, b = node.args[0], node.args[-1]
    if node.op == NEG:
        return _sub(ZERO, da)
    if node.op == "+":
        return _add(da, db)
    if node.op == "-":
        return _sub(da, db)
    if node.op == "*":
        return _add(_mul(da, b), _mul(a, db))
    if node.op == "/":
        return _div(_sub(da, _mul(node, db)), b)
    return _power_slope(node, da, db)


def _power_slope(node: Node, da: Node, db: Node) -> Node:
    a, b = node.args
    if db == ZERO:
        lower = number(b.value - 1) if b.op == NUMBER else _sub(b, ONE)
        return _mul(_mul(b, Node("**", (a, lower))), da)
    return _mul(node, _add(_mul(db, _call("log", a)), _div(_mul(b, da), a)))


def _outer_slope(node: Node) -> Node:
    """d f(z) / dz of a function of one argument."""
    z = node.args[0]
    slopes: dict[str, Callable[[], Node]] = {
        "sqrt": lambda: _div(HALF, node),
        "ssqrt": lambda: _div(HALF, _call("sqrt", _call("abs", z))),
        "abs": lambda: _call("sign", z),
        "sign": lambda: ZERO,
        "pos": lambda: _mul(HALF, _add(ONE, _call("sign", z))),
        "exp": lambda: node,
        "log": lambda: _div(ONE, z),
        "sin": lambda: _call("cos", z),
        "cos": lambda: _sub(ZERO, _call("sin", z)),
        "tanh": lambda: _sub(ONE, _mul(node, node)),
    }
    return slopes[node.op]()


def _pair_slope(node: Node, da: Node, db: Node) -> Node:
    a, b = node.args
    if node.op == "hypot":
        return _div(_add(_mul(a, da), _mul(b, db)), node)
    larger, smaller = (da, db) if node.op == "max" else (db, da)  # where a > b, and where a < b
    side = _call("sign", _sub(a, b))
    upper = _mul(_mul(HALF, _add(ONE, side)), larger)
    return _add(upper, _mul(_mul(HALF, _sub(ONE, side)), smaller))


def named(name: str) -> Node:
    """The tree of a name."""
    return Node(NAME, name=name)


def substituted(node: Node, by: Mapping[str, Node]) -> Node:
    """The tree with names replaced by trees."""
    if node.op == NAME:
        return by.get(node.name, node)
    if not any(name in by for name in node.names):
        return node
    args = tuple(substituted(arg, by) for arg in node.args)
    if node.op == "-" and args[1] == ZERO:
        return args[0]
    return Node(node.op, args, node.value, node.name, node.column)


_LEVEL = {"+": 1, "-": 1, "*": 2, "/": 2, NEG: 3, "**": 4}
_ATOM = 5


def written(node: Node) -> str:
    """The tree as text that reads back as the same tree."""
    if node.op == NUMBER:
        return repr(int(node.value)) if node.value.is_integer() else repr(node.value)
    if node.op == NAME:
        return node.name
    if node.op == NEG:
        return "-" + _inside(node.args[0], 3)
    if node.op == "**":
        return f"{_inside(node.args[0], _ATOM)}**{_inside(node.args[1], 3)}"
    if node.op in OPERATORS:
        level = _LEVEL[node.op]
        left, right = node.args
        return f"{_inside(left, level)} {node.op} {_inside(right, level + 1)}"
    return f"{node.op}({', '.join(written(arg) for arg in node.args)})"


def _inside(node: Node, least: int) -> str:
    text = written(node)
    return text if _LEVEL.get(node.op, _ATOM) >= least else f"({text})"
