"""Effects that a user defines: a flow per unit of a coefficient, in Python or as an expression.

    @rtid.effects.define("m3/s/Pa/m", chambers={"a": -1, "b": 1}, largest=1e-9, x0=[0.1, 0.2, 0.3])
    def worn_groove(view, x0):
        return np.maximum(view.x - x0, 0.0) * (view.p["p_a"] - view.p["p_b"])

The flow into chamber c is coefficient * sign_c * flow(view, shape).  The coefficient is estimated;
a shape parameter (x0) is tried over its bank of values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from rtid.effects.dimension import (
    FLOW,
    Dimension,
    dimension,
    dimension_of_unit,
    unit_of_dimension,
)
from rtid.effects.expression import Expression
from rtid.effects.page import EffectError
from rtid.effects.tree import FloatArray
from rtid.effects.view import View

MOST_SHAPES = 64  # combinations of all banks: each is a column of its own
Flow = Callable[..., FloatArray]  # (view, **shape) -> (n,)


@dataclass(frozen=True)
class UserEffect:
    """A flow that somebody suspects: c * sign_c * function(view, **shape) into chamber c, m3/s.

    unit: of the coefficient c, SI.  signs: (chamber, +1 or -1) pairs.  sign: of a possible c, 0 for
    either; largest: its largest possible size.  shapes: bank of values of each shape parameter.
    """

    name: str
    unit: str
    signs: tuple[tuple[str, int], ...]
    function: Flow = field(compare=False)
    sign: int = 1
    largest: float = math.inf
    shapes: tuple[tuple[str, tuple[float, ...]], ...] = ()
    title: str = ""
    source: str = ""  # the expression, or where the function stands

    def bank(self) -> Iterator[dict[str, float]]:
        """Every combination of the shape parameters; one empty one where there are none."""
        names = [name for name, _ in self.shapes]
        for values in product(*(values for _, values in self.shapes)):
            yield dict(zip(names, values, strict=True))

    def flow(self, view: View, shape: Mapping[str, float] | None = None) -> FloatArray:
        """Flow per unit of the coefficient, m3/s, (n,); EffectError unless (n,) and finite."""
        shape = shape or {}
        try:
            found = np.asarray(self.function(view, **shape), dtype=np.float64)
            found = np.broadcast_to(found, view.t_s.shape).copy()
        except EffectError:
            raise
        except Exception as error:
            reason = f"effect {self.name!r} fails: {type(error).__name__}: {error}"
            raise EffectError(reason, f"correct {self.source or 'its function'}") from error
        wrong = np.flatnonzero(~np.isfinite(found))
        if len(wrong):
            reason = f"effect {self.name!r} is not finite in {len(wrong)} of {len(found)} samples"
            at = f"the first at {view.t_s[wrong[0]]:g} s" + (f", with {dict(shape)}" * bool(shape))
            raise EffectError(f"{reason}, {at}", "guard roots, logarithms and quotients")
        return found

    def volume(self, view: View, shape: Mapping[str, float] | None = None) -> FloatArray:
        """Volume per unit of the coefficient over each interval, m3, (n - 1,).

        The command is held over the interval, all else is linear between its samples.
        """
        at_start = self.flow(view, shape)[:-1]
        at_end = self.flow(view.before_the_next_command, shape)
        return 0.5 * (at_start + at_end) * np.diff(view.t_s)


def make(
    name: str,
    unit: str,
    function: Flow,
    *,
    chambers: Mapping[str, int],
    sign: int = 1,
    largest: float = math.inf,
    shapes: Mapping[str, Sequence[float]] | None = None,
    title: str = "",
    source: str = "",
) -> UserEffect:
    """A checked UserEffect; EffectError names what is wrong with it."""
    banks = {key: tuple(float(v) for v in values) for key, values in (shapes or {}).items()}
    effect = UserEffect(
        name, unit, tuple(chambers.items()), function, sign, largest, tuple(banks.items()), title,
        source,
    )  # fmt: skip
    for wrong, remedy in _faults(effect):
        raise EffectError(f"effect {name!r}: {wrong}", remedy)
    return effect


def _faults(effect: UserEffect) -> Iterator[tuple[str, str]]:
    dimension_of_unit(effect.unit)
    if not effect.signs or any(sign not in (1, -1) for _, sign in effect.signs):
        yield "chambers must give +1 or -1 for at least one", 'e.g. chambers={"a": -1, "b": 1}'
    if effect.sign not in (1, 0, -1):
        yield f"sign is {effect.sign}", "write 1, -1, or 0 for either"
    if not effect.largest > 0:
        yield f"largest is {effect.largest}", "give the largest size of the coefficient, > 0"
    for name, values in effect.shapes:
        if not values or not all(math.isfinite(v) for v in values):
            yield f"{name} has no finite values", f"e.g. {name}=[0.1, 0.2, 0.3]"
    count = math.prod(len(values) for _, values in effect.shapes)
    if count > MOST_SHAPES:
        yield f"has {count} combinations of shapes", f"keep them to {MOST_SHAPES}"


def define(
    unit: str,
    *,
    chambers: Mapping[str, int],
    name: str = "",
    sign: int = 1,
    largest: float = math.inf,
    **shapes: Sequence[float],
) -> Callable[[Flow], UserEffect]:
    """Turn a function (view, **shape) -> (n,) into a `UserEffect`; all other keys are shapes.

    unit: of the coefficient; function times coefficient is m3/s.  name: the function's, if empty.
    """

    def wrap(function: Flow) -> UserEffect:
        return make(
            name or function.__name__,
            unit,
            function,
            chambers=chambers,
            sign=sign,
            largest=largest,
            shapes=shapes,
            title=(function.__doc__ or "").strip().partition("\n")[0],
            source=f"{function.__module__}.{function.__name__}",
        )

    return wrap


def from_expression(
    name: str,
    text: str,
    unit: str,
    *,
    names: Mapping[str, Dimension | None],
    constants: Mapping[str, float] | None = None,
    **keys: Any,
) -> UserEffect:
    """A UserEffect from an expression over the names of a view, constants and shape parameters.

    names: those of a view with their dimension, see `names_of_model`; keys: as of `make`.  Raises
    ExpressionError with the place in the text, EffectError where the unit does not fit or a shape
    is not used.
    """
    shapes, constants = keys.get("shapes") or {}, dict(constants or {})
    known = {**names, **dict.fromkeys(constants), **dict.fromkeys(shapes)}
    expression = Expression.parse(text, known)
    for shape in shapes:
        if shape not in expression.names:
            raise EffectError(f"effect {name!r}: flow does not use {shape!r}", "use it, or drop it")
    _check_unit(name, expression, unit, known)
    own = {n: value for n, value in constants.items() if n not in names}

    def function(view: View, **shape: float) -> FloatArray:
        given = own | shape
        return expression.value(
            {n: given[n] if n in given else view.value(n) for n in expression.names}
        )

    return make(name, unit, function, source=text, **keys)


def _check_unit(
    name: str, expression: Expression, unit: str, known: Mapping[str, Dimension | None]
) -> None:
    """Refuse a coefficient whose unit does not turn the expression into a flow."""
    found, given = dimension(expression, known, literal_is_pure=False), dimension_of_unit(unit)
    if found is None:
        return
    wanted = tuple(a - b for a, b in zip(FLOW, found, strict=True))
    if given != wanted:
        reason = f"flow is in {unit_of_dimension(found)}, times {unit} that is no m3/s"
        remedy = f"write unit = {unit_of_dimension(wanted)!r}, or correct flow"
        raise EffectError(f"effect {name!r}: {reason}", remedy)
