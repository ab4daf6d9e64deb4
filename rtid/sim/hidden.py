"""Physics to hide in a simulated machine, for a diagnosis to find.

Each effect is simulated in another form, or by another integrator, than the column that looks for
it: gaps widen with pressure, edges have a laminar foot, valves a soft knee, plays rounded corners.
Its strength is in the unit of the effect catalogue, and is the coefficient that the plain column
has over a record, within about 10 %.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

from rtid.errors import RtidError
from rtid.sim import extra_flows as flows
from rtid.sim.extra import Extra, Planted
from rtid.sim.plant import EDGES, Plant

LEVELS = ("weak", "middle", "strong")
CHAMBERS = ("a", "b")
EITHER = (*CHAMBERS, "")  # "" is both
ANYWHERE = ("",)
VALVES = EDGES[:4]
LAMINAR, TURBULENT = "m3/s/Pa", "m3/s/sqrt(Pa)"
MATERIAL_GAS_PA = 1.5e6  # where the stated share of air is as soft as isothermal air


class HiddenError(RtidError):
    """An effect, a place or a strength that the simulator does not know."""

    exit_code = 2


@dataclass(frozen=True)
class Hidden:
    """An effect that can be hidden.

    form: how it is simulated; strengths: weak, middle, strong for the default machine, in `unit`;
    places: where it can sit, the first without being told; catalogue: what a diagnosis calls it,
    "" if it must not be found in the pressure equations.
    """

    name: str
    form: str
    unit: str
    strengths: tuple[float, float, float]
    places: tuple[str, ...]
    apply: Callable[[Plant, float, str], Plant]
    catalogue: str

    def strength(self, level: str) -> float:
        """Strength of a level by name, or a number as text; HiddenError for anything else."""
        if level in LEVELS:
            return self.strengths[LEVELS.index(level)]
        try:
            return float(level)
        except ValueError as error:
            remedy = f"use {', '.join(LEVELS)} or a number in {self.unit or '1'}"
            raise HiddenError(f"{self.name}={level}: no strength", remedy) from error


def hide(plant: Plant, name: str, strength: float, where: str = "") -> Plant:
    """The plant with the effect in it, besides what it hides already; strength 0 changes nothing.

    Raises HiddenError for an unknown name, an impossible place, a negative or repeated strength.
    """
    effect = known(name)
    where = where or effect.places[0]
    if where not in effect.places:
        places = ", ".join(place for place in effect.places if place) or "the whole machine alone"
        raise HiddenError(f"{name}: cannot sit at {where!r}", f"it can sit at {places}")
    if not 0.0 <= strength < float("inf"):
        raise HiddenError(f"{name}: strength {strength:g}", "give a positive number")
    if any((name, where) == (h.name, h.where) for h in plant.hidden):
        raise HiddenError(f"{name}: hidden twice in one place", "hide it once, stronger")
    if strength == 0.0:
        return plant
    changed = effect.apply(plant, float(strength), where)
    return replace(changed, hidden=(*plant.hidden, Planted(name, where, float(strength))))


def hide_wish(plant: Plant, wish: str) -> Plant:
    """The plant with a wish of the form EFFECT[:WHERE][=STRENGTH] fulfilled, middle by default."""
    place, _, strength = wish.partition("=")
    name, _, where = place.partition(":")
    return hide(plant, name, known(name).strength(strength or "middle"), where)


def known(name: str) -> Hidden:
    """The effect with this name; HiddenError with the list of all."""
    if name not in HIDDEN:
        raise HiddenError(f"{name}: no such effect", f"use one of {', '.join(HIDDEN)}")
    return HIDDEN[name]


def _extra(plant: Plant, **numbers: Any) -> Plant:
    changed: Extra = plant.extra._replace(**numbers)
    return replace(plant, extra=changed)


def _number(field: str) -> Callable[[Plant, float, str], Plant]:
    """An effect that is one number of `Extra`, of the whole machine."""
    return lambda plant, strength, where: _extra(plant, **{field: strength})


def _at(field: str, names: tuple[str, ...]) -> Callable[[Plant, float, str], Plant]:
    """An effect that is one number of `Extra` per chamber or edge; "" is all of them."""

    def apply(plant: Plant, strength: float, where: str) -> Plant:
        old = getattr(plant.extra, field)
        pairs = zip(names, old, strict=True)
        new = tuple(strength if where in ("", name) else value for name, value in pairs)
        return _extra(plant, **{field: new})

    return apply


def _opening(
    flow: str, opening: str, of_load: float, of_supply: float
) -> Callable[[Plant, float, str], Plant]:
    """A valve on a chamber: A opens at a share of the load's pressure, B at one of the supply."""

    def apply(plant: Plant, strength: float, where: str) -> Plant:
        c = plant.constants
        at_rest_pa = (c.gravity_n + 0.3 * plant.p_supply_pa * c.area_b_m2) / c.area_a_m2
        pressures = {"a": of_load * at_rest_pa, "b": of_supply * plant.p_supply_pa}
        plant = _at(opening, CHAMBERS)(plant, pressures[where], where)
        return _at(flow, CHAMBERS)(plant, strength, where)

    return apply


def _air(plant: Plant, strength: float, where: str) -> Plant:
    kappa, p_pa = flows.POLYTROPIC, MATERIAL_GAS_PA
    softer = (p_pa / flows.ATMOSPHERE_PA) ** (1.0 - 1.0 / kappa) / kappa
    return _extra(plant, air_share=strength / softer)


def _line(plant: Plant, strength: float, where: str) -> Plant:
    return _at("line_m", CHAMBERS)(plant, strength / flows.INERTANCE_KGPM5, where)


def _line_seen_at_valve(plant: Plant, strength: float, where: str) -> Plant:
    return _extra(_line(plant, strength, where), sensor_at_valve=1.0)


def _spool(plant: Plant, strength: float, where: str) -> Plant:
    return _extra(plant, spool_radps=strength, spool_damping=0.9)


def _measured_sag(plant: Plant, strength: float, where: str) -> Plant:
    return _extra(plant, sag_pasm3=strength, sag_measured=1.0)


def _constant(field: str) -> Callable[[Plant, float, str], Plant]:
    """More of one of the mechanical constants."""

    def apply(plant: Plant, strength: float, where: str) -> Plant:
        more = getattr(plant.constants, field) + strength
        return replace(plant, constants=plant.constants._replace(**{field: more}))

    return apply


def _table(effects: Iterable[tuple[object, ...]]) -> dict[str, Hidden]:
    found = [Hidden(*effect) for effect in effects]  # type: ignore[arg-type]
    return {effect.name: effect for effect in found}


# fmt: off
_KNOWN = (
    ("internal_leakage_laminar", "gap past the piston that widens with pressure",
     LAMINAR, (0.6e-12, 2e-12, 6e-12), ANYWHERE, _number("internal_laminar")),
    ("external_leakage_laminar", "gap to tank that widens with pressure",
     LAMINAR, (0.3e-12, 1e-12, 3e-12), CHAMBERS, _at("external_laminar", CHAMBERS)),
    ("valve_seat_leakage", "gap of the seat, at right angles to the opening, laminar foot 0.1 MPa",
     TURBULENT, (1e-9, 3e-9, 9e-9), VALVES, _at("seat", EDGES)),
    ("entrained_air", "volume of a polytropic mixture; share as soft as isothermal air at 1.5 MPa",
     "1", (0.01, 0.03, 0.09), ANYWHERE, _air),
    ("extra_dead_volume", "blind volume behind a port, 2 ms late",
     "m3", (1.3e-4, 4e-4, 1.2e-3), EITHER[::-1], _at("dead_volume_m3", CHAMBERS)),
    ("line_dynamics", "pi section of a 13 mm hose, turbulent loss; sensor at the cylinder",
     "Pa s2/m3", (0.8e7, 2.4e7, 7e7), EITHER[::-1], _line),
    ("spool_lag_second_order", "five spools of slightly different frequency, damping 0.9",
     "rad/s", (600.0, 200.0, 65.0), ANYWHERE, _spool),
    ("input_delay", "the held command arrives late, also between samples",
     "s", (1.5e-3, 5e-3, 15e-3), ANYWHERE, _number("delay_s")),
    ("valve_hysteresis", "eight plays in parallel, 0.65 to 1.35 of the full width: round corners",
     "V", (0.03, 0.1, 0.3), ANYWHERE, _number("play_v")),
    ("supply_sag", "saturating pump, polytropic accumulator; the column holds the set pressure",
     "Pa s/m3", (3.6e8, 1.1e9, 3.3e9), ANYWHERE, _number("sag_pasm3")),
    ("relief_valve", "poppet with a soft knee of 0.15 MPa",
     LAMINAR, (3e-12, 9e-12, 27e-12), CHAMBERS, _opening("relief", "relief_open_pa", 1.3, 0.78)),
    ("valve_gain_drift", "all gains warm up exponentially over half the record",
     "1", (0.01, 0.03, 0.09), ANYWHERE, _number("gain_drift")),
)
# fmt: on
HIDDEN = _table((*effect, effect[0]) for effect in _KNOWN)
