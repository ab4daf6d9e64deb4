"""Arithmetic expressions over named arrays, read safely: `Expression.parse("p_a - p_b", names)`.

Nothing of the text is ever run.  Known are numbers, pi, the given names, + - * / **, brackets and
sqrt, ssqrt, abs, sign, pos, exp, log, sin, cos, tanh, min, max, hypot.  Values follow IEEE: sqrt of
a negative number is NaN, a division by zero is infinite or NaN, NaN in one sample stays in this
sample; no warning is printed.  Whoever needs finite values checks them (see `rtid.effects.law`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rtid.effects import tree
from rtid.effects.parsing import ExpressionError, parse
from rtid.effects.tree import Node
from rtid.plain import FloatArray
from rtid.units import nearest


@dataclass(frozen=True)
class Expression:
    """One expression: its text and its tree."""

    text: str
    root: Node

    @classmethod
    def parse(cls, text: str, names: Collection[str] | None = None) -> Expression:
        """Read the text; only these names may occur in it, any if None.

        Raises ExpressionError with the place (a caret) and what to write instead.
        """
        return cls(*parse(text, names))

    @property
    def names(self) -> tuple[str, ...]:
        """Names that it uses, in the order of their first appearance."""
        return self.root.names

    def __call__(self, **values: ArrayLike) -> FloatArray:
        """Value for these values of the names, broadcast together; other names are ignored."""
        return self.value(values)

    def value(self, values: Mapping[str, ArrayLike]) -> FloatArray:
        """As a call, values (...) of any unit in a mapping; ExpressionError if one is missing."""
        for name in self.names:
            if name not in values:
                column = max(self.text.find(name), 0)
                near = nearest(name, list(values))
                raise ExpressionError(self.text, column, f"{name!r} has no value", near)
        arrays = {name: np.asarray(values[name], dtype=np.float64) for name in self.names}
        with np.errstate(all="ignore"):
            return np.asarray(tree.evaluate(self.root, arrays), dtype=np.float64)

    def derivative(self, name: str) -> Expression:
        """The partial derivative to a name, symbolic; the mean of both sides at a corner."""
        root = tree.derivative(self.root, name)
        return Expression(tree.written(root), root)

    def __str__(self) -> str:
        return tree.written(self.root)
