"""Hide physics in a simulated machine, for a diagnosis to find; `hideable` says what there is."""

from __future__ import annotations

import math
from dataclasses import replace

from rtid.sim.extra_physics import Planted
from rtid.sim.hideable import BEYOND, KNOWN, LEVELS, MECHANICS, Hidden, HiddenError
from rtid.sim.simulated_plant import SimulatedPlant

__all__ = ["HIDDEN", "LEVELS", "MECHANICAL", "OUTSIDE", "Hidden", "HiddenError", "hide"]

HIDDEN = KNOWN | BEYOND | MECHANICS
OUTSIDE = tuple(BEYOND)  # in no catalogue: a diagnosis has to say that it does not know them
MECHANICAL = tuple(MECHANICS)  # not in the pressure equations: a diagnosis has to stay silent


def hide(plant: SimulatedPlant, name: str, strength: float, where: str = "") -> SimulatedPlant:
    """The plant with the effect in it, besides what it hides already; strength 0 changes nothing.

    Raises HiddenError for an unknown name, an impossible place or strength, or where two effects
    would set the same number.
    """
    effect = known(name)
    where = where or effect.places[0]
    if where not in effect.places:
        places = ", ".join(place for place in effect.places if place) or "the whole machine alone"
        raise HiddenError(f"{name}: cannot sit at {where!r}", f"it can sit at {places}")
    if not math.isfinite(strength) or (strength < 0.0 and not effect.signed):
        raise HiddenError(f"{name}: strength {strength:g}", "give a positive number")
    if any((name, where) == (h.name, h.where) for h in plant.hidden):
        raise HiddenError(f"{name}: hidden twice in one place", "hide it once, stronger")
    if strength == 0.0:
        return plant
    changed = effect.apply(plant, float(strength), where)
    return replace(changed, hidden=(*plant.hidden, Planted(name, where, float(strength))))


def hide_wish(plant: SimulatedPlant, wish: str) -> SimulatedPlant:
    """The plant with a wish of the form EFFECT[:WHERE][=STRENGTH] fulfilled, middle by default."""
    place, _, strength = wish.partition("=")
    name, _, where = place.partition(":")
    return hide(plant, name, known(name).strength(strength or "middle"), where)


def known(name: str) -> Hidden:
    """The effect with this name; HiddenError with the list of all."""
    if name not in HIDDEN:
        raise HiddenError(f"{name}: no such effect", f"use one of {', '.join(HIDDEN)}")
    return HIDDEN[name]
