"""Small curves of signals: of a file without a project, of a record that is being learned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rtid.tell.html import text
from rtid.units import find_unit

if TYPE_CHECKING:
    from rtid.plain import FloatArray
    from rtid.trace.glance import Curve

SPOKEN = {"pressure": "MPa", "m": "mm", "m/s": "mm/s"}  # of a dimension, or of a unit


def spoken(curve: Curve) -> tuple[float, float, str]:
    """Range and unit of a signal as the rest of the page says them."""
    low, high = float(np.nanmin(curve.low)), float(np.nanmax(curve.high))
    unit = find_unit(curve.unit)
    name = SPOKEN.get(curve.unit) or (unit and SPOKEN.get(unit.dimension))
    other = find_unit(name) if name else None
    if unit is None or other is None:
        return low, high, curve.unit
    return unit.si(low) / other.factor, unit.si(high) / other.factor, other.name


def spark(low: FloatArray, high: FloatArray, wide: float = 160.0) -> str:
    """A band from the least to the largest value (pieces,) of each piece, any unit."""
    known = np.isfinite(low) & np.isfinite(high)
    low, high, n = low[known], high[known], max(int(known.sum()) - 1, 1)
    top, span = float(high.max()), max(float(high.max() - low.min()), 1e-300)
    above = [f"{wide * k / n:.1f},{2 + 34 * (top - y) / span:.1f}" for k, y in enumerate(high)]
    below = [f"{wide * k / n:.1f},{3 + 34 * (top - y) / span:.1f}" for k, y in enumerate(low)]
    path = " ".join([*above, *reversed(below)])
    return (
        f'<svg viewBox="0 0 {wide:g} 40" preserveAspectRatio="none" aria-hidden="true">'
        f'<polygon points="{path}"/></svg>'
    )


def record(curves: Sequence[Curve]) -> str:
    """A whole record, before anything is learned from it: a strip for each of its signals."""
    strips = "".join(_strip(curve) for curve in curves if np.isfinite(curve.low).any())
    return f'<div class="signals">{strips}</div>' if strips else ""


def _strip(curve: Curve) -> str:
    low, high, unit = spoken(curve)
    return (
        f"<b>{text(curve.name)}</b><span>{low:.3g} to {high:.3g} {text(unit)}</span>"
        f"{spark(curve.low, curve.high, 800.0)}"
    )
