"""Simulated records for the diagnosis, each made once."""

from __future__ import annotations

from functools import cache

import numpy as np

from rtid.estimator.chunk import to_chunk
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.hidden import hide
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate
from tests.campaign.plants import grid

DURATION_S, HELD_OUT_S = 40.0, 30.0


@cache
def record(
    effect: str = "", strength: float = 0.0, seed: int = 3, motion: str = "rich", where: str = ""
) -> tuple[Machine, FloatArray, FloatArray]:
    """Model, identification and held-out part of a random machine with a hidden effect.

    where: "" for its first place.
    """
    plant = draw(seed)
    if effect:
        plant = hide(plant, effect, strength, where)
    run = simulate(plant, motion, seed, DURATION_S)
    model = declared_model(plant, seed=seed, grid=grid(plant.p_supply_pa))
    chunk = to_chunk(model, run.samples, 0)
    held_out = chunk[:, 0] >= HELD_OUT_S
    return model, chunk[~held_out], chunk[held_out]


def noisy(rng: np.random.Generator, n: int) -> FloatArray:
    """White noise of unit variance (n,)."""
    return np.asarray(rng.standard_normal(n))
