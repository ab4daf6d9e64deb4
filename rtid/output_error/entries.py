"""Which effects a plant by equations can have, and what sets the size of their parameters."""

from __future__ import annotations

from dataclasses import dataclass

from rtid.effects import Effect, effect
from rtid.output_error.own import EFFECTS
from rtid.output_error.plant import PlantError
from rtid.units import nearest

# What sets the size of a parameter: the term that it multiplies, a signal, a time of the record.
AMPLITUDE, INPUT, LIMIT, STATE, SPEED, GAP, TIME, RATE, SHARE = (
    "amplitude",
    "input",
    "limit",
    "state",
    "speed",
    "gap",
    "time",
    "rate",
    "share",
)


@dataclass(frozen=True)
class Entry:
    """Which states (by quantity) an effect may act on, and the kind of each of its parameters."""

    quantities: tuple[str, ...]
    kinds: dict[str, str]
    spills: bool = False


_STORES = ("level", "pressure")
ENTRIES = {
    "offset": Entry(("level", "pressure", "temperature", "velocity"), {"constant": AMPLITUDE}),
    "overflow": Entry(("level",), {"rate": RATE, "rim": STATE}, spills=True),
    "heat_loss": Entry(("temperature",), {"rate": AMPLITUDE}),
    "linear_outflow": Entry(("level",), {"coefficient": AMPLITUDE}, spills=True),
    "external_leakage_laminar": Entry(("pressure",), {"coefficient": AMPLITUDE}, spills=True),
    "external_leakage_turbulent": Entry(_STORES, {"coefficient": AMPLITUDE}, spills=True),
    "coulomb_friction": Entry(("velocity",), {"force": AMPLITUDE}),
    "viscous_friction": Entry(("velocity",), {"coefficient": AMPLITUDE}),
    "stribeck_friction": Entry(("velocity",), {"force": AMPLITUDE, "velocity": SPEED}),
    "cubic_stiffness": Entry(("velocity",), {"coefficient": AMPLITUDE}),
    "saturation": Entry((), {"limit": LIMIT}),
    "dead_zone": Entry((), {"threshold": INPUT}),
    "pure_delay": Entry((), {"delay": TIME}),
    "first_order_lag": Entry((), {"time_constant": TIME}),
    "backlash": Entry(("displacement",), {"width": GAP}),
}


def page_of(name: str) -> Effect:
    """The page of an effect that a plant by equations can have; PlantError for any other."""
    if name not in ENTRIES:
        raise PlantError(
            f"{name} is no effect of a plant by equations", nearest(name, list(ENTRIES))
        )
    return EFFECTS.get(name) or effect(name)
