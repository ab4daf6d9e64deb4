"""Random machines: every constant within +-30 % of the default, every valve a map of its own.

Drawn as somebody would design them.  Valves and load are sized to the cylinder (their ratio to its
area is what varies).  The four valves are of one type: a common part of gain and dead band, and
scatter between them; with freely drawn dead bands the chamber that is filled opens long after the
one that is drained, and the machine cavitates.  The lag stays within the +-0.2 ms that the user
declares.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.sim.hidden import hide, known
from rtid.sim.simulated_plant import (
    AB,
    AT,
    BT,
    EDGES,
    PA,
    PB,
    Constants,
    Controller,
    SimulatedPlant,
    Valve,
)
from rtid.sim.valve_laws import numbers

SPREAD = 0.3  # of every constant
TYPE = 0.2  # of a valve type's gain and dead band; with the scatter of its valves within SPREAD
GAIN_SCATTER, DEADBAND_SCATTER = 0.08, 0.05
CROSS_PORT_SHARE = 0.3  # the cross-port valve is small, else it short-circuits the chambers


def draw(seed: int, *, cross_port: bool = False, law: str = "orifice") -> SimulatedPlant:
    """The machine with this number, its valves of a law in `rtid.sim.valve_laws`.

    cross_port also opens A->B while retracting (u < 0).
    """
    rng = np.random.default_rng([seed, 1])
    nominal = SimulatedPlant()
    constants = Constants(*(_vary(rng, value) for value in nominal.constants))
    size = constants.area_a_m2 / nominal.constants.area_a_m2
    constants = constants._replace(
        area_b_m2=nominal.constants.area_b_m2 * size * rng.uniform(0.85, 1.15),
        gravity_n=_vary(rng, nominal.constants.gravity_n) * size,
    )
    common = Valve(
        gain=_vary(rng, Valve.gain, TYPE) * size, deadband_v=_vary(rng, Valve.deadband_v, TYPE)
    )
    small = replace(common, gain=CROSS_PORT_SHARE * common.gain)
    valves = _fill_first([*(_valve(rng, common) for _ in EDGES[:AB]), _valve(rng, small)])
    if law != "orifice":
        valves = _of_law(seed, valves, law)
    return SimulatedPlant(
        constants=constants,
        controller=_controller(rng, valves, size),
        valves=valves,
        directions=(1, -1, -1, 1, -1 if cross_port else 0),
        lag_s=nominal.lag_s + rng.uniform(-0.2e-3, 0.2e-3),
    )


def _of_law(seed: int, valves: tuple[Valve, ...], law: str) -> tuple[Valve, ...]:
    """The same valves by another law, each with numbers of its own."""
    rng = np.random.default_rng([seed, 8])
    own = [numbers(rng, law) for _ in valves]
    return tuple(
        replace(v, law=law, law_a=a, law_b=b) for v, (a, b) in zip(valves, own, strict=True)
    )


def draw_hidden(
    seed: int, name: str, level: str = "middle", *, law: str = "orifice"
) -> SimulatedPlant:
    """The machine with this number and an effect in it, varied +-30 %, in a random place.

    Effects that can have either sign get a random one.

    level: weak, middle or strong.  Raises HiddenError for an unknown name or level.
    """
    rng = np.random.default_rng([seed, 7])
    effect = known(name)
    strength = _vary(rng, effect.strength(level))
    where = effect.places[int(rng.integers(len(effect.places)))]
    if effect.signed:
        strength *= float(rng.choice([-1.0, 1.0]))
    return hide(draw(seed, law=law), name, strength, where)


def _vary(rng: np.random.Generator, value: float, spread: float = SPREAD) -> float:
    return value * float(rng.uniform(1 - spread, 1 + spread))


def _valve(rng: np.random.Generator, common: Valve) -> Valve:
    return Valve(
        gain=_vary(rng, common.gain, GAIN_SCATTER),
        deadband_v=_vary(rng, common.deadband_v, DEADBAND_SCATTER),
        corner_v=float(rng.uniform(0.1, 0.2)),
        curve_1pv=_vary(rng, Valve.curve_1pv),
        ripple=float(rng.uniform(0.05, 0.2)),
        ripple_rate_radpv=float(rng.uniform(0.8, 1.6)),
        ripple_phase_rad=float(rng.uniform(0, 2 * np.pi)),
    )


def _fill_first(valves: list[Valve]) -> tuple[Valve, ...]:
    """The same dead bands, dealt out so that the chamber that is filled opens first."""
    for supply, tank in ((PA, BT), (PB, AT)):
        low, high = sorted((valves[supply].deadband_v, valves[tank].deadband_v))
        valves[supply] = replace(valves[supply], deadband_v=low)
        valves[tank] = replace(valves[tank], deadband_v=high)
    return tuple(valves)


def _controller(rng: np.random.Generator, valves: tuple[Valve, ...], size: float) -> Controller:
    """What the machine's controller believes of its valves: their mean, up to 15 % wrong."""
    gain = float(np.mean([valve.gain for valve in valves[:4]]))
    deadband_v = float(np.mean([valve.deadband_v for valve in valves[:4]]))
    return Controller(
        volts_per_mps=_vary(rng, Controller().volts_per_mps * size * Valve.gain / gain, 0.15),
        deadband_v=deadband_v * float(rng.uniform(0.8, 1.0)),
    )
