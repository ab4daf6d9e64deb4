"""What can be hidden in a simulated machine: one row per effect, its form and its strengths.

Each effect is simulated in another form, or by another integrator, than the column that looks for
it: gaps widen with pressure, edges have a laminar foot, valves a soft knee, plays rounded corners.
Its strength is in the unit of its page, and is the coefficient that the plain column has over a
record, within about 10 %.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rtid.effects import effect
from rtid.errors import RtidError
from rtid.sim import extra_flows as flows
from rtid.sim.extra_physics import Extra
from rtid.sim.simulated_plant import EDGES, SimulatedPlant

WORN = "internal_leakage_laminar=middle"  # what the demo's machine has
LEVELS = ("weak", "middle", "strong")
CHAMBERS = ("a", "b")
EITHER = ("", *CHAMBERS)  # "" is both
ANYWHERE = ("",)
VALVES = EDGES[:4]
LAMINAR, TURBULENT = "m3/s/Pa", "m3/s/sqrt(Pa)"
SPOOL_DAMPING = 0.9
MATERIAL_GAS_PA = 2.2e6  # where the stated share of air is as soft as isothermal air


class HiddenError(RtidError):
    """An effect, a place or a strength that the simulator does not know."""

    exit_code = 2


@dataclass(frozen=True)
class Hidden:
    """An effect that can be hidden.

    form: how it is simulated; strengths: weak, middle, strong for the default machine, in `unit`;
    places: where it can sit, the first without being told; catalogue: what a diagnosis calls it,
    "" if its catalogue does not have it.
    """

    name: str
    form: str
    unit: str
    strengths: tuple[float, float, float]
    places: tuple[str, ...]
    apply: Callable[[SimulatedPlant, float, str], SimulatedPlant]
    catalogue: str
    signed: bool = False  # a negative strength is possible, too

    def strength(self, level: str) -> float:
        """Strength of a level by name, or a number as text; HiddenError for anything else."""
        if level in LEVELS:
            return self.strengths[LEVELS.index(level)]
        try:
            return float(level)
        except ValueError as error:
            remedy = f"use {', '.join(LEVELS)} or a number in {self.unit or '1'}"
            raise HiddenError(f"{self.name}={level}: no strength", remedy) from error


def _extra(plant: SimulatedPlant, **numbers: Any) -> SimulatedPlant:
    for name, value in numbers.items():
        old = np.asarray(getattr(plant.extra, name))
        if np.any((old != 0.0) & (old != value)):
            remedy = "hide one of the two, or each in a place of its own"
            raise HiddenError(f"{name}: another hidden effect has set it already", remedy)
    changed: Extra = plant.extra._replace(**numbers)
    return replace(plant, extra=changed)


def _number(field: str) -> Callable[[SimulatedPlant, float, str], SimulatedPlant]:
    """An effect that is one number of `Extra`, of the whole machine."""
    return lambda plant, strength, where: _extra(plant, **{field: strength})


def _at(
    field: str, names: tuple[str, ...]
) -> Callable[[SimulatedPlant, float, str], SimulatedPlant]:
    """An effect that is one number of `Extra` per chamber or edge; "" is all of them."""

    def apply(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
        old = getattr(plant.extra, field)
        pairs = zip(names, old, strict=True)
        new = tuple(strength if where in ("", name) else value for name, value in pairs)
        return _extra(plant, **{field: new})

    return apply


def _opening(
    flow: str, opening: str, of_load: float, of_supply: float
) -> Callable[[SimulatedPlant, float, str], SimulatedPlant]:
    """A valve on a chamber: A opens at a share of the load's pressure, B at one of the supply."""

    def apply(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
        c = plant.constants
        at_rest_pa = (c.gravity_n + 0.3 * plant.p_supply_pa * c.area_b_m2) / c.area_a_m2
        pressures = {"a": of_load * at_rest_pa, "b": of_supply * plant.p_supply_pa}
        plant = _at(opening, CHAMBERS)(plant, pressures[where], where)
        return _at(flow, CHAMBERS)(plant, strength, where)

    return apply


def _air(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
    kappa, p_pa = flows.POLYTROPIC, MATERIAL_GAS_PA
    softer = (p_pa / flows.ATMOSPHERE_PA) ** (1.0 - 1.0 / kappa) / kappa
    return _extra(plant, air_share=strength / softer)


def _line(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
    return _at("line_m", CHAMBERS)(plant, strength / flows.INERTANCE_KGPM5, where)


def _line_seen_at_valve(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
    return _extra(_line(plant, strength, where), sensor_at_valve=1.0)


def _spool(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
    return _extra(plant, spool_radps=strength, spool_damping=SPOOL_DAMPING, spool_order=2.0)


def _second_lag(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
    return _extra(plant, spool_lag_s=strength, spool_order=1.0)


def _rate_limit(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
    return _extra(plant, spool_rate_vps=strength, spool_order=3.0)


def _deadbands(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
    shares = zip(plant.valves, (1.0, 1.1, 0.9, 1.05, 0.95), strict=True)
    wider = tuple(replace(v, deadband_v=v.deadband_v + share * strength) for v, share in shares)
    return replace(plant, valves=wider)


def _measured_sag(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
    return _extra(plant, sag_pasm3=strength, sag_measured=1.0)


def _constant(field: str) -> Callable[[SimulatedPlant, float, str], SimulatedPlant]:
    """More of one of the mechanical constants."""

    def apply(plant: SimulatedPlant, strength: float, where: str) -> SimulatedPlant:
        more = getattr(plant.constants, field) + strength
        return replace(plant, constants=plant.constants._replace(**{field: more}))

    return apply


# fmt: off
_CATALOGUE = (
    ("internal_leakage_laminar", "gap past the piston that widens with pressure",
     (0.6e-12, 2e-12, 6e-12), ANYWHERE, _number("internal_laminar")),
    ("external_leakage_laminar", "gap to tank that widens with pressure",
     (0.3e-12, 1e-12, 3e-12), CHAMBERS, _at("external_laminar", CHAMBERS)),
    ("valve_seat_leakage", "gap of the seat, at right angles to the opening, laminar foot 0.1 MPa",
     (0.5e-9, 1.5e-9, 4.5e-9), VALVES, _at("seat", EDGES)),
    ("entrained_air", "volume of a polytropic mixture; share as soft as isothermal air at 2.2 MPa",
     (0.01, 0.03, 0.09), ANYWHERE, _air),
    ("extra_dead_volume", "blind volume behind a port, 2 ms late",
     (1.3e-4, 4e-4, 1.2e-3), EITHER, _at("dead_volume_m3", CHAMBERS)),
    ("line_dynamics", "pi section of a 13 mm hose, turbulent loss; sensor at the cylinder",
     (0.8e7, 2.4e7, 7e7), EITHER, _line),
    ("spool_lag_second_order", "five spools of slightly different frequency, damping 0.9",
     (600.0, 200.0, 65.0), ANYWHERE, _spool),
    ("input_delay", "the held command arrives late, also between samples",
     (1.5e-3, 5e-3, 15e-3), ANYWHERE, _number("delay_s")),
    ("valve_hysteresis", "eight plays in parallel, 0.65 to 1.35 of the full width: round corners",
     (0.03, 0.1, 0.3), ANYWHERE, _number("play_v")),
    ("supply_sag", "saturating pump, polytropic accumulator; the column holds the set pressure",
     (3.6e8, 1.1e9, 3.3e9), ANYWHERE, _number("sag_pasm3")),
    ("relief_valve", "poppet with a soft knee of 0.1 MPa",
     (3e-12, 9e-12, 27e-12), CHAMBERS, _opening("relief", "relief_open_pa", 1.3, 0.78)),
    ("valve_gain_drift", "all gains warm up exponentially, time constant 1.5 records",
     (0.01, 0.03, 0.09), ANYWHERE, _number("gain_drift")),
    ("internal_leakage_turbulent", "sharp edge past the piston, laminar below 30 kPa",
     (0.7e-9, 2e-9, 6e-9), ANYWHERE, _number("internal_turbulent")),
    ("external_leakage_turbulent", "sharp edge to tank, laminar below 30 kPa",
     (0.4e-9, 1.2e-9, 3.6e-9), CHAMBERS, _at("external_turbulent", CHAMBERS)),
    ("hose_compliance", "hose wall, 1 ms late, half as soft at 12 MPa as at 4 MPa",
     (1.6e-13, 5e-13, 1.5e-12), EITHER, _at("hose_m3ppa", CHAMBERS)),
    ("spool_lag_first_order", "a second lag behind the spool's own 1.3 ms",
     (1.5e-3, 5e-3, 15e-3), ANYWHERE, _second_lag),
    ("deadband_shift", "dead bands that are wider than before, each by 0.9 to 1.1 of it",
     (0.05, 0.15, 0.45), ANYWHERE, _deadbands),
    ("makeup_valve", "check valve with a soft knee of 0.1 MPa",
     (3e-12, 9e-12, 27e-12), CHAMBERS, _opening("makeup", "makeup_open_pa", 1.0, 0.18)),
    ("cavitation", "share of the volume that boils out, with the square of what lacks",
     (1.5e-3, 4.5e-3, 13e-3), ("b", "a"), _opening("released", "release_pa", 0.9, 0.25)),
    ("pressure_sensor_lag", "two equal lags of half the time one behind the other",
     (0.5e-3, 1.5e-3, 5e-3), EITHER, _at("pressure_lag_s", CHAMBERS)),
    ("pressure_sensor_bias", "the sensor's zero is off",
     (0.1e6, 0.3e6, 0.6e6), CHAMBERS, _at("pressure_bias_pa", CHAMBERS)),
    ("position_sensor_delay", "the sensor is late, also for the controller",
     (0.5e-3, 1.5e-3, 5e-3), ANYWHERE, _number("position_delay_s")),
    ("velocity_scale", "the velocity's sensor reads too much",
     (0.02, 0.06, 0.2), ANYWHERE, _number("velocity_scale")),
    ("position_dependent_leakage", "gap with a bell-shaped groove, 1 cm beyond mid-stroke",
     (2e-12, 6e-12, 18e-12), ANYWHERE, _number("groove")),
    ("load_compensated_valve", "the flow's share that saturates above 0.2 MPa, as at 2 MPa",
     (0.1, 0.3, 0.9), (*VALVES, ""), _at("compensated", EDGES)),
    ("spool_rate_limit", "five spools, each of its lag, whose fastest is slightly different",
     (120.0, 60.0, 30.0), ANYWHERE, _rate_limit),
    ("oil_stiffening", "modulus that rises in a straight line with the absolute pressure",
     (3e-9, 9e-9, 27e-9), ANYWHERE, _number("stiffening")),
)
_VARIANTS = (
    ("line_dynamics_seen_at_valve", "as line_dynamics; sensors at the valves' end",
     (0.8e7, 2.4e7, 7e7), EITHER, _line_seen_at_valve, "line_dynamics"),
)
_OUTSIDE = (
    ("groove_one_way", "groove 1 cm beyond mid-stroke whose lip opens while extending",
     LAMINAR, (3e-12, 9e-12, 27e-12), ANYWHERE, _number("groove_one_way")),
    ("flow_bursts", "half sines of 0.05 to 0.3 s of either sign into A, 0.7 a second",
     "m3/s", (2e-6, 6e-6, 18e-6), ANYWHERE, _number("burst_m3s")),
    ("stick_slip_pilot", "the pilot rests until the command is so far away, follows, sticks again",
     "V", (0.05, 0.15, 0.45), ANYWHERE, _number("stick_v")),
    ("supply_branch_resonance", "branch to the edge pa with a 9 Hz resonance, damping 0.1",
     "Pa s2/m3", (0.3e8, 1e8, 3e8), ANYWHERE, _number("branch_kgpm4")),
    ("gain_oscillation", "all gains swing with a period of 7 s",
     "1", (0.01, 0.03, 0.09), ANYWHERE, _number("gain_swing")),
)
_MECHANICAL = (
    ("friction_change", "more Coulomb friction", "N", (100.0, 300.0, 900.0), ANYWHERE,
     _constant("coulomb_n")),
    ("load_change", "more weight of the boom", "N", (200.0, 600.0, 1800.0), ANYWHERE,
     _constant("gravity_n")),
    ("mass_change", "more mass", "kg", (40.0, 120.0, 360.0), ANYWHERE, _constant("mass_kg")),
    ("supply_sag_measured", "as supply_sag; the supply is measured",
     "Pa s/m3", (3.6e8, 1.1e9, 3.3e9), ANYWHERE, _measured_sag),
)
# fmt: on


def _table(rows: Iterable[tuple[Any, ...]]) -> dict[str, Hidden]:
    return {row[0]: Hidden(*row) for row in rows}


def _of_page(row: tuple[Any, ...], name: str) -> Hidden:
    """An effect of the catalogue: unit and sign are those of its page."""
    hidden, form, strengths, places, apply = row
    size = effect(name).size
    unit = OTHER_UNITS.get(name, size.unit)
    return Hidden(hidden, form, unit, strengths, places, apply, name, size.sign == 0)


OTHER_UNITS = {"cavitation": "1"}  # of the volume: its page's compliance times where it begins
KNOWN = {row[0]: _of_page(row, row[0]) for row in _CATALOGUE}
KNOWN |= {row[0]: _of_page(row[:-1], row[-1]) for row in _VARIANTS}
BEYOND = _table((*row, "") for row in _OUTSIDE)
MECHANICS = _table((*row, "") for row in _MECHANICAL)
