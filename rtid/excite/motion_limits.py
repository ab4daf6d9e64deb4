"""What a designed motion may do, and the check that it does."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rtid.errors import RtidError
from rtid.excite.driving import OFFSET, SUPPLY
from rtid.plain import FloatArray

ROUNDING = 1e-9  # share by which a rounded number may exceed its limit


class LimitError(RtidError):
    """The motion would break a limit, or the limits leave no motion."""


@dataclass(frozen=True)
class Limits:
    """Ranges are (low, high), SI; a supply whose ends agree is constant, offset_v = 0: no dither.

    command_rate_vps: of the offset that is added to the controller's command; pressure_pa: of the
    chambers; supply_rate_paps: of the supply's setpoint; stops_m: mechanical stops that the piston
    may be held against, None for none.
    """

    duration_s: float
    stroke_m: tuple[float, float]
    speed_mps: float
    command_v: float
    pressure_pa: tuple[float, float]
    supply_pa: tuple[float, float]
    supply_rate_paps: float = 5e6
    offset_v: float = 0.0
    command_rate_vps: float = 50.0
    may_shut: bool = True
    stops_m: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Refuse limits that leave no motion."""
        wrong = {
            "duration_s": self.duration_s <= 0,
            "stroke": self.stroke_m[0] >= self.stroke_m[1],
            "speed": self.speed_mps <= 0,
            "command": self.command_v <= 0,
            "pressure": self.pressure_pa[0] >= self.pressure_pa[1],
            "supply": self.supply_pa[0] > self.supply_pa[1],
            "supply_rate": self.supply_rate_paps <= 0,
            "command_rate": self.command_rate_vps <= 0,
            "offset": self.offset_v < 0,
            "stops": self.stops_m is not None
            and not self.stops_m[0] <= self.stroke_m[0] < self.stroke_m[1] <= self.stops_m[1],
        }
        bad = [name for name, is_wrong in wrong.items() if is_wrong]
        if bad:
            raise LimitError(f"limits leave no motion: {', '.join(bad)}", "adapt [excite]")

    def without(self, seconds: float) -> Limits:
        """The same for so much less time."""
        return replace(self, duration_s=self.duration_s - seconds)

    @property
    def supply_varies(self) -> bool:
        """Whether the supply pressure may be moved."""
        return self.supply_pa[1] > self.supply_pa[0]


class Extremes(NamedTuple):
    """A quantity of a motion, the range that it stays in, and the range that is allowed."""

    quantity: str
    unit: str
    low: float
    high: float
    least: float
    most: float
    at_s: float  # where it is nearest to its limit, or furthest beyond

    @property
    def is_kept(self) -> bool:
        """Whether it stays within its limit."""
        slack = ROUNDING * max(abs(self.least), abs(self.most))
        return self.low >= self.least - slack and self.high <= self.most + slack


def extremes(
    limits: Limits,
    reference: FloatArray,
    t_s: FloatArray,
    x_m: FloatArray,
    u_v: FloatArray,
    pressures_pa: FloatArray,
) -> tuple[Extremes, ...]:
    """Every limited quantity of a motion (n,), pressures_pa (n, chambers), beside its limit.

    reference (n, 5) as `driving`.
    """
    step_s = float(t_s[1] - t_s[0])
    speed = np.abs(np.gradient(x_m, t_s))
    supply, offset = reference[:, SUPPLY], np.abs(reference[:, OFFSET])
    chamber = pressures_pa.max(axis=1), pressures_pa.min(axis=1)
    rate = np.abs(np.diff(supply, append=supply[-1])) / step_s
    return (
        _extreme("position", "m", x_m, x_m, limits.stroke_m, t_s),
        _extreme("speed", "m/s", speed, speed, (0.0, limits.speed_mps), t_s),
        _extreme("command", "V", np.abs(u_v), np.abs(u_v), (0.0, limits.command_v), t_s),
        _extreme("pressure", "Pa", chamber[1], chamber[0], limits.pressure_pa, t_s),
        _extreme("supply", "Pa", supply, supply, limits.supply_pa, t_s),
        _extreme("supply rate", "Pa/s", rate, rate, (0.0, limits.supply_rate_paps), t_s),
        _extreme("offset", "V", offset, offset, (0.0, limits.offset_v), t_s),
    )


def _extreme(
    quantity: str,
    unit: str,
    low: FloatArray,
    high: FloatArray,
    allowed: tuple[float, float],
    t_s: FloatArray,
) -> Extremes:
    least, most = allowed
    beyond: FloatArray = np.maximum(high - most, least - low)
    at = float(t_s[int(beyond.argmax())])
    return Extremes(quantity, unit, float(low.min()), float(high.max()), least, most, at)


def require_kept(extremeses: tuple[Extremes, ...]) -> None:
    """Raise LimitError that names every limit which is broken."""
    broken = [
        f"{e.quantity} {e.low:.4g} to {e.high:.4g} {e.unit}, allowed {e.least:.4g} to {e.most:.4g},"
        f" worst at {e.at_s:.2f} s"
        for e in extremeses
        if not e.is_kept
    ]
    if broken:
        raise LimitError("; ".join(broken), "slow it down, or widen that limit in [excite]")
