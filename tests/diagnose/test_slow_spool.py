"""Spools of one pole that is slower than declared: there is no declared one before it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rtid.diagnose.diagnosis import search
from rtid.diagnose.summary import diagnosis
from rtid.estimator.chunk import to_chunk
from rtid.model import Lag
from rtid.sim.declare import declared_model
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate
from tests.campaign.plants import grid

SEED, LAG_S = 11, 10e-3


@pytest.mark.long
def test_it_takes_the_place_of_the_declared_lag() -> None:
    """As a pole behind the declared one both were 5 ms, and left 15 times the noise."""
    plant = replace(draw(SEED), lag_s=LAG_S)
    model = declared_model(plant, seed=SEED, grid=grid(plant.p_supply_pa))
    model = replace(model, lag=Lag(3.5e-3, 0.7e-3))
    chunk = to_chunk(model, simulate(plant, "rich", SEED, 40.0).samples, 0)
    said = diagnosis(search(model, chunk[:30_000], chunk[30_000:]))
    (slow,) = said.found
    slow_s = slow.parameters["time_constant"].value
    assert slow.effect == "spool_lag_first_order" and said.lag_s < 0.02 * LAG_S
    assert slow_s + said.lag_s == pytest.approx(LAG_S, rel=5e-3)
    assert said.rho_after < 1.1
    assert said.beta_pa == pytest.approx([plant.beta_pa] * 2, rel=0.01)
