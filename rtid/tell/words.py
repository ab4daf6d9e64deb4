"""Words of terminal, page and report alike: headings of the verdicts, sizes, names of effects.

VERDICTS: a kind, for the colour, and the heading.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeGuard

from rtid.effects.page import title
from rtid.units import with_unit

if TYPE_CHECKING:
    from rtid.diagnose.report import Value

VERDICTS = {
    "matches": ("good", "The model matches"),
    "missing": ("found", "Something is missing, and has a name"),
    "ambiguous": ("open", "Something is missing: one of a set"),
    "unknown": ("open", "Something unknown is missing"),
    "insufficient_data": ("open", "This record cannot tell"),
}

LEAST_FLOOR = 5e-5  # of the rms flow: a floor below it is shown as 0.00 %, which no sensor has


def is_floor(floor: float | None, flow: float = 100.0) -> TypeGuard[float]:
    """Whether a sensors' floor is told: where one disturbance stands for all, no sensor's does.

    floor: in the unit of the rms flow, or in % of it.
    """
    return floor is not None and floor > LEAST_FLOOR * flow


def quantity(value: Value) -> str:
    """Value, 95 % interval and unit, as a person reads them."""
    return with_unit(value.value, value.unit, value.std)


def named(key: tuple[str, str]) -> str:
    """Title and place of an effect."""
    return f"{title(key[0])} ({key[1]})" if key[1] else title(key[0])
