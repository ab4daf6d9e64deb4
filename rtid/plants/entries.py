"""Which effects a plant by equations can have: what sets the size of their parameters."""

from __future__ import annotations

from rtid.effects import Effect, catalogue
from rtid.plants.plant import PlantError
from rtid.units import nearest

# What sets the size of a parameter: the term that it multiplies, a signal, a time of the record.
AMPLITUDE, INPUT, LIMIT, STATE, SPEED = "amplitude", "input", "limit", "state", "speed"
GAP, TIME, RATE, SHARE = "gap", "time", "rate", "share"


def effects_of_plants() -> dict[str, Effect]:
    """The effects that a plant by equations can have, by name: their pages say a size for each."""
    return {
        name: page for name, page in catalogue().items() if all(p.size for p in page.parameters)
    }


def page_of(name: str) -> Effect:
    """The page of an effect that a plant by equations can have; PlantError for any other."""
    known = effects_of_plants()
    if name not in known:
        raise PlantError(f"{name} is no effect of a plant by equations", nearest(name, list(known)))
    return known[name]
