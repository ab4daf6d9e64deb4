"""A lag behind the opening curve: an amplifier that jumps over the dead band, then a slow spool."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose.diagnosis import search
from rtid.diagnose.exact import opens_at
from rtid.diagnose.standing import fitted
from rtid.effects.laws.timing import lagged, lagged_opening, second_order, second_order_opening
from rtid.estimator.chunk import to_chunk
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model, default_grid
from rtid.sim.hidden import hide
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate

DT, DEAD_V = 1e-3, 1.7


def record(size: float, slow: str = "spool_lag_first_order") -> tuple[Machine, FloatArray]:
    """44 s of valves without overlap; what is sent has the dead band that the amplifier jumps.

    size: of what makes them slow, s or rad/s; 0 for nothing.
    """
    plant = draw(7301)
    valves = tuple(replace(v, deadband_v=0.5 * v.corner_v) for v in plant.valves)
    controller = plant.controller._replace(deadband_v=0.02)
    plant = replace(plant, valves=valves, controller=controller)
    plant = hide(plant, slow, size) if size else plant
    grid = default_grid(1.25 * plant.p_supply_pa)
    model = declared_model(plant, seed=7301, grid=grid, safe_band_v=1.0)
    chunk = to_chunk(model, simulate(plant, "rich_record", 7301, 44.0).samples, 0)
    u = chunk[:, 2 + model.column(model.edges[0].command)]
    u += np.sign(u) * DEAD_V
    return model, chunk


def test_a_valve_that_is_told_to_shut_still_closes() -> None:
    u = np.concatenate([np.full(100, -5.0), np.full(100, -1.0)])
    out = lagged_opening(u, DT, (0.02, DEAD_V))
    plain = lagged(np.concatenate([np.full(100, 5.0 - DEAD_V), np.zeros(100)]), DT, (0.02,))
    is_open = plain > 0.2
    assert is_open.sum() > 150
    assert out[is_open] == pytest.approx(-DEAD_V - plain[is_open], abs=1e-4)
    assert lagged_opening(np.full(9, -1.0), DT, (0.02, DEAD_V)) == pytest.approx(np.full(9, -1.0))


def test_a_valve_that_swings_behind_its_opening_rests_where_it_is_shut() -> None:
    u = np.concatenate([np.full(100, 1.0), np.full(200, 5.0), np.full(300, 1.0)])
    psi = 60.0, 0.4
    out = second_order_opening(u, DT, (*psi, DEAD_V))
    plain = second_order(np.where(u > DEAD_V, 5.0 - DEAD_V, 0.0), DT, psi)
    is_open = plain > 0.2
    assert out[is_open] == pytest.approx(DEAD_V + plain[is_open], abs=1e-4)
    assert out.max() > 5.5 and plain.min() < -0.5, "it swings"
    assert out.min() == pytest.approx(1.0), "below what is sent it has nowhere to go"


@pytest.mark.campaign
def test_a_swing_behind_the_opening_is_no_delay() -> None:
    """Before the opening curve it was 35 rad/s of 40 on a third party's rig, and a delay won."""
    model, chunk = record(60.0, "spool_lag_second_order")
    found = search(model, chunk[:32_000], chunk[33_200:])
    (timing, psi), *others = found.last.revision.timings
    assert [f.key for f in found.found] == [("spool_lag_second_order", "command")] and not others
    assert timing.parameters == ("natural_frequency", "damping", "dead_band")
    assert psi[:2] == pytest.approx((60.0, 0.9), rel=0.05)
    assert found.last.rho < 0.02 * found.first.rho


@pytest.mark.campaign
def test_a_lag_behind_the_opening_is_no_delay_and_no_late_sensor() -> None:
    """It was 6 ms of delay and 21 ms of a late position, rho 1,881 -> 343."""
    model, chunk = record(30e-3)
    found = search(model, chunk[:32_000], chunk[33_200:])
    (timing, psi), *others = found.last.revision.timings
    assert [f.key for f in found.found] == [("spool_lag_first_order", "command")] and not others
    assert timing.parameters == ("time_constant", "dead_band")
    assert psi[0] == pytest.approx(30e-3, rel=0.03)
    assert found.last.rho < 0.02 * found.first.rho


@pytest.mark.long
def test_the_maps_show_where_their_valves_open() -> None:
    model, chunk = record(0.0)
    fit = fitted(model, chunk[:32_000])
    assert opens_at(fit.view) == pytest.approx(DEAD_V, abs=0.1)
