"""Dimensions: of a unit such as "m3/s/sqrt(Pa)", and of an expression over quantities with units.

A dimension is the powers of m, kg, s, K and V; V stands for the unit of a command, whatever it is.
None is "any": the literal 0.1 in `x - 0.1` has the unit of x, a shape parameter that of its place.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction

from rtid.effects.expression import Expression
from rtid.effects.parsing import ExpressionError
from rtid.effects.tree import NAME, NEG, NUMBER, Node

Dimension = tuple[Fraction, ...]
BASE = ("m", "kg", "s", "K", "V")


def _of(**powers: int) -> Dimension:
    return tuple(Fraction(powers.get(name, 0)) for name in BASE)


PURE = _of()
FLOW = _of(m=3, s=-1)
UNITS: dict[str, Dimension] = {
    **{name: _of(**{name: 1}) for name in BASE},
    "rad": PURE,
    "Hz": _of(s=-1),
    "N": _of(m=1, kg=1, s=-2),
    "Pa": _of(m=-1, kg=1, s=-2),
    "J": _of(m=2, kg=1, s=-2),
    "W": _of(m=2, kg=1, s=-3),
}


def dimension_of_unit(unit: str) -> Dimension:
    """Dimension of a coherent SI unit: "m3/s/Pa", "m3/(s Pa)", "N s/m", "m3/s/sqrt(Pa)", "1".

    Raises ExpressionError for a unit that is not known, or not SI (L, MPa, min).
    """
    spelled = re.sub(r"([A-Za-z])(-?\d+)", r"\1**\2", unit.strip())
    spelled = re.sub(r"(?<=[\w)])\s+(?=[A-Za-z(])", "*", spelled)
    try:
        spelled_dimension = dimension(Expression.parse(spelled, UNITS), UNITS)
    except ExpressionError as error:
        remedy = "write it in " + ", ".join(UNITS)
        raise ExpressionError(unit, 0, f"{unit!r} is no SI unit", remedy) from error
    assert spelled_dimension is not None, "every unit has a dimension"
    return spelled_dimension


def unit_of_dimension(powers: Dimension) -> str:
    """The dimension as a unit, e.g. "m3/s"."""
    parts = [_power(name, p) for name, p in zip(BASE, powers, strict=True) if p > 0]
    under = ["/" + _power(name, -p) for name, p in zip(BASE, powers, strict=True) if p < 0]
    return (" ".join(parts) or "1") + "".join(under)


def _power(name: str, power: Fraction) -> str:
    if power.denominator == 2:
        whole = power.numerator
        return f"sqrt({name}{whole if whole != 1 else ''})"
    return name if power == 1 else f"{name}{power}"


def dimension(
    expression: Expression, known: Mapping[str, Dimension | None], *, literal_is_pure: bool = True
) -> Dimension | None:
    """Dimension of an expression, None if it cannot be told; ExpressionError where units clash.

    With `literal_is_pure` a number that multiplies has no unit; else it may have any, as in what a
    user writes with SI numbers in it.
    """
    return _Judge(expression.text, known, literal_is_pure).of(expression.root)


class _Judge:
    def __init__(
        self, text: str, known: Mapping[str, Dimension | None], literal_is_pure: bool
    ) -> None:
        self.text, self.known, self.literal_is_pure = text, known, literal_is_pure

    def of(self, node: Node) -> Dimension | None:
        if node.op in (NUMBER, NAME):
            literal = PURE if self.literal_is_pure else None
            return literal if node.op == NUMBER else self.known[node.name]
        if node.op == "**":
            return self._power(node)
        dimensions = [self.of(arg) for arg in node.args]
        if node.op in ("*", "/"):
            return _product(dimensions[0], dimensions[1], 1 if node.op == "*" else -1)
        if node.op in ("+", "-", "min", "max", "hypot"):
            return self._alike(node, *dimensions)
        return self._function(node, dimensions[0])

    def _alike(self, node: Node, a: Dimension | None, b: Dimension | None) -> Dimension | None:
        """Both sides must have one unit; a bare number takes the other's."""
        if _is_literal(node.args[0]) or a is None:
            return b
        if _is_literal(node.args[1]) or b is None:
            return a
        if a != b:
            units = f"{unit_of_dimension(a)} and {unit_of_dimension(b)}"
            raise self._error(node, f"{node.op} joins {units}", "both sides need the same unit")
        return a

    def _function(self, node: Node, inner: Dimension | None) -> Dimension | None:
        if node.op in ("abs", "pos", NEG):
            return inner
        if node.op in ("sqrt", "ssqrt"):
            return None if inner is None else tuple(power / 2 for power in inner)
        if node.op != "sign" and inner is not None and inner != PURE:
            unit = unit_of_dimension(inner)
            raise self._error(
                node, f"{node.op} of a quantity in {unit}", "divide it by a scale first"
            )
        return PURE

    def _power(self, node: Node) -> Dimension | None:
        base, inner = node.args[0], self.of(node.args[0])
        exponent = _literal_value(node.args[1])
        if inner is None or inner == PURE or _is_literal(base):
            return inner
        if exponent is None:
            raise self._error(
                node, "a power of a quantity needs a number", "divide it by a scale first"
            )
        share = Fraction(exponent).limit_denominator(12)
        return tuple(power * share for power in inner)

    def _error(self, node: Node, reason: str, remedy: str) -> ExpressionError:
        return ExpressionError(self.text, node.column, reason, remedy)


def _product(first: Dimension | None, second: Dimension | None, turn: int) -> Dimension | None:
    if first is None or second is None:
        return None
    return tuple(a + turn * b for a, b in zip(first, second, strict=True))


def _is_literal(node: Node) -> bool:
    return node.op == NUMBER or (node.op == NEG and _is_literal(node.args[0]))


def _literal_value(node: Node) -> float | None:
    """Value of a number, a negated number or a quotient of numbers."""
    if node.op == NUMBER:
        return node.value
    if node.op not in (NEG, "/"):
        return None
    values = [_literal_value(arg) for arg in node.args]
    if any(value is None for value in values) or (node.op == "/" and not values[-1]):
        return None
    first, last = values[0] or 0.0, values[-1] or 1.0
    return -first if node.op == NEG else first / last
