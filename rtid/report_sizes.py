"""Sizes of effects as page and report show them: in the units of the workshop, with 95 %."""

from __future__ import annotations

from math import isfinite, nan

from rtid.diagnose.report import Value
from rtid.diagnosed_text import quantity
from rtid.units import PRACTICAL

Z95 = 1.96
KEPT = ("s", "m3", "Pa", "m3/s")  # quantity() turns these round itself


def size(value: Value) -> str:
    """With its 95 % interval, where it has one."""
    unit, factor = _workshop(value.unit)
    std = Z95 * value.std if isfinite(value.std) else nan
    return quantity(Value(factor * value.value, factor * std, unit))


def limit(value: float, unit: str) -> str:
    """Without an interval, in two digits."""
    name, factor = _workshop(unit)
    return quantity(Value(float(f"{factor * value:.2g}"), nan, name))


def _workshop(unit: str) -> tuple[str, float]:
    return (unit, 1.0) if unit in KEPT else PRACTICAL.get(unit, (unit, 1.0))
