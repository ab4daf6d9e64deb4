"""Kinds of machine drawn at random: a compensated valve, a 4/3 spool, a vane motor.

    compensated   each edge its own valve whose flow is flat in dp beyond some 0.8 MPa
    spool         four edges ground on one spool, that of the sensor's zero off by up to 0.25 V
    vane          a motor of limited angle: equal displacements, chambers that swap their volume

A motor that goes round for ever is among `tests.campaign.modelica`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.sim.hidden import hide, known
from rtid.sim.random_plants import draw
from rtid.sim.simulated_plant import AB, AT, BT, PA, PB, SimulatedPlant
from tests.campaign.laws import DEFAULT, Case

COMPENSATED, SPOOL, VANE = KINDS = ("compensated", "spool", "vane")
WIDER, NARROWER = (PA, BT), (PB, AT)  # edges whose overlap a zero that is off makes wider
OFF_V, GROUND = 0.25, 0.03  # of the spool's zero; scatter between edges of one spool
HIDDEN = ("internal_leakage_laminar", "spool_lag_first_order", "extra_dead_volume")


@dataclass(frozen=True)
class KindCase(Case):
    """A machine of a kind; law is the kind's name."""

    @property
    def plant(self) -> SimulatedPlant:
        """The machine, with what is hidden in it, of middle strength."""
        plant = kind_of(self.seed, self.law)
        if not self.hidden:
            return plant
        return hide(plant, self.hidden, known(self.hidden).strength("middle"))

    @property
    def grid(self) -> str:
        """The simulator's own: 44 s do not fill that of `rtid init`."""
        return DEFAULT


def kind_of(seed: int, kind: str) -> SimulatedPlant:
    """The machine of a kind with this number."""
    if kind == COMPENSATED:
        return draw(seed, law=COMPENSATED)
    rng = np.random.default_rng([seed, 12])
    return _one_spool(draw(seed), rng) if kind == SPOOL else _vane(draw(seed))


def _one_spool(plant: SimulatedPlant, rng: np.random.Generator) -> SimulatedPlant:
    off_v, like = float(rng.uniform(-OFF_V, OFF_V)), plant.valves[PA]
    valves = list(plant.valves)
    for edge in range(AB):
        gain = like.gain * float(rng.uniform(1.0 - GROUND, 1.0 + GROUND))
        off = off_v if edge in WIDER else -off_v
        valves[edge] = replace(like, gain=gain, deadband_v=like.deadband_v + off)
    return replace(plant, valves=tuple(valves))


def _vane(plant: SimulatedPlant) -> SimulatedPlant:
    of = plant.constants
    return replace(plant, constants=of._replace(area_b_m2=of.area_a_m2, v0_b_m3=of.v0_a_m3))
