"""Effects that a user defines: a flow per unit of a coefficient, in Python or as an expression.

    @rtid.effects.define("m3/s/Pa/m", chambers={"a": -1, "b": 1}, largest=1e-9, x0=[0.1, 0.2, 0.3])
    def worn_groove(view, x0):
        return np.maximum(view.x - x0, 0.0) * (view.p["p_a"] - view.p["p_b"])

The flow into chamber c is coefficient * sign_c * flow(view, shape).  The coefficient is estimated;
a shape parameter (x0) is tried over its bank of values, and refined between them.  What comes out
is an `Effect` like those of the catalogue, in the names of the user's machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from rtid.effects.dimension import (
    FLOW,
    UNITS,
    Dimension,
    dimension,
    dimension_of_unit,
    unit_of_dimension,
)
from rtid.effects.expression import Expression
from rtid.effects.page import FUNCTION, Effect, EffectError, Parameter, Symbol
from rtid.effects.parsing import ExpressionError
from rtid.plain import FloatArray

MOST_SHAPES = 64  # combinations of all banks: each is a column of its own
COEFFICIENT = "coefficient"
Flow = Callable[..., FloatArray]  # (view, **shape) -> (n,)


def make(
    name: str,
    unit: str,
    flow: str | Flow,
    *,
    chambers: Mapping[str, int],
    sign: int = 1,
    largest: float = math.inf,
    shapes: Mapping[str, Sequence[float]] | None = None,
    units: Mapping[str, str] | None = None,
    constants: Mapping[str, float] | None = None,
    title: str = "",
    source: str = "",
) -> Effect:
    """A checked effect of a user's; EffectError names what is wrong with it.

    flow: a formula in the names of the machine, or a function; units: of shape parameters.
    """
    banks = {key: tuple(float(v) for v in values) for key, values in (shapes or {}).items()}
    for wrong, remedy in _faults(unit, chambers, sign, largest, banks):
        raise EffectError(f"effect {name!r}: {wrong}", remedy)
    size = Parameter(
        COEFFICIENT, unit, COEFFICIENT, 0.0 if sign > 0 else -largest,
        largest if sign >= 0 else 0.0, sign, "flow per unit",
    )  # fmt: skip
    text = f"({flow})" if isinstance(flow, str) else FUNCTION
    return Effect(
        name=name,
        title=title or name.replace("_", " "),
        kind="flow",
        places=("chamber",),
        summary=title,
        equation=tuple(
            f"q_{chamber} = {'-' * (way < 0)}{COEFFICIENT} * {text}"
            for chamber, way in chambers.items()
        ),
        symbols=tuple(Symbol(n, "", "", value) for n, value in (constants or {}).items()),
        parameters=(
            size,
            *(_shape(n, bank, (units or {}).get(n, "")) for n, bank in banks.items()),
        ),
        signals=(),
        signature="",
        confounders=(),
        separates="",
        visible_when="",
        invisible=False,
        reference=source,
        into=tuple(chambers.items()),
        function=None if isinstance(flow, str) else flow,
    )


def _shape(name: str, bank: tuple[float, ...], unit: str) -> Parameter:
    """A nonlinear parameter, a step beyond its bank at most."""
    low, high = min(bank), max(bank)
    step = (high - low) / max(1, len(bank) - 1)
    return Parameter(name, unit, name, low - step, high + step, 0, "", start=tuple(sorted(bank)))


def _faults(
    unit: str,
    chambers: Mapping[str, int],
    sign: int,
    largest: float,
    banks: Mapping[str, tuple[float, ...]],
) -> Iterator[tuple[str, str]]:
    dimension_of_unit(unit)
    if not chambers or any(way not in (1, -1) for way in chambers.values()):
        yield "chambers must give +1 or -1 for at least one", 'e.g. chambers={"a": -1, "b": 1}'
    if sign not in (1, 0, -1):
        yield f"sign is {sign}", "write 1, -1, or 0 for either"
    if not largest > 0:
        yield f"largest is {largest}", "give the largest size of the coefficient, > 0"
    for name, values in banks.items():
        if not values or not all(math.isfinite(v) for v in values):
            yield f"{name} has no finite values", f"e.g. {name}=[0.1, 0.2, 0.3]"
    count = math.prod(len(values) for values in banks.values())
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
) -> Callable[[Flow], Effect]:
    """Turn a function (view, **shape) -> (n,) into an `Effect`; all other keys are shapes.

    unit: of the coefficient; function times coefficient is m3/s.  name: the function's, if empty.
    """

    def wrap(function: Flow) -> Effect:
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
) -> Effect:
    """An effect from an expression over the names of a view, constants and shape parameters.

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
    free = {n: v for n, v in constants.items() if n not in names and n in expression.names}
    units = {shape: _unit_of(shape, expression, known) for shape in shapes}
    return make(name, unit, expression.text, constants=free, units=units, **keys)


def _unit_of(shape: str, expression: Expression, known: Mapping[str, Dimension | None]) -> str:
    """The unit of a nonlinear parameter, by its place in the formula; "" where that is open."""
    possible = [
        unit
        for unit in ("1", *UNITS)
        if _fits(expression, {**known, shape: dimension_of_unit(unit)})
    ]
    return possible[0] if len({dimension_of_unit(unit) for unit in possible}) == 1 else ""


def _fits(expression: Expression, known: Mapping[str, Dimension | None]) -> bool:
    try:
        dimension(expression, known, literal_is_pure=False)
    except ExpressionError:
        return False
    return True


def _check_unit(
    name: str, expression: Expression, unit: str, known: Mapping[str, Dimension | None]
) -> None:
    """Refuse a coefficient whose unit does not turn the expression into a flow."""
    computed, given = dimension(expression, known, literal_is_pure=False), dimension_of_unit(unit)
    if computed is None:
        return
    wanted = tuple(a - b for a, b in zip(FLOW, computed, strict=True))
    if given != wanted:
        reason = f"flow is in {unit_of_dimension(computed)}, times {unit} that is no m3/s"
        remedy = f"write unit = {unit_of_dimension(wanted)!r}, or correct flow"
        raise EffectError(f"effect {name!r}: {reason}", remedy)
