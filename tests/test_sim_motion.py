"""What the simulated machine is asked to do: ingredients alone, and records with their parts."""

import numpy as np
import pytest

from rtid.plain import FloatArray
from rtid.sim.closed_loop import DITHER, LOAD, P_SUPPLY, V_REF, X_REF
from rtid.sim.demand import MOTIONS, parts_s, usual_duration_s
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant


def drive(motion: str, duration_s: float = 20.0) -> FloatArray:
    return MOTIONS[motion](SimulatedPlant(), np.random.default_rng(5), duration_s)


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_has_one_row_more_than_samples(motion: str) -> None:
    assert drive(motion, 3.3).shape == (3301, 6)


@pytest.mark.parametrize(
    ("motion", "column"), [("dither", DITHER), ("supply", P_SUPPLY), ("load", LOAD)]
)
def test_an_ingredient_alone_is_the_sweep_with_one_column_more(motion: str, column: int) -> None:
    alone, sweep, rich = drive(motion), drive("sweep"), drive("rich")
    others = [c for c in range(6) if c != column]
    assert np.array_equal(alone[:, others], sweep[:, others])
    assert np.ptp(alone[:, column]) > 0 == np.ptp(sweep[:, column])
    assert np.std(alone[:, column]) == pytest.approx(np.std(rich[:, column]), rel=0.5)


def test_a_push_compresses_oil_behind_shut_valves() -> None:
    run = simulate(draw(4), "push", 4, 24.0)
    pushing = slice(0, 6000)
    assert not run.truth.flow_m3s[pushing].any()
    assert np.ptp(run.truth.signals[pushing, 1]) > 0.5e6
    assert run.truth.flow_m3s[6000:].any()


@pytest.mark.parametrize("motion", ["sweep_record", "rich_record"])
def test_a_record_has_a_part_to_learn_from_and_one_to_be_judged_by(motion: str) -> None:
    assert usual_duration_s(motion) == 110.0 and usual_duration_s("sweep") == 80.0
    assert parts_s(motion, 110.0) == {
        "identification_s": pytest.approx((0, 80)),
        "validation_s": pytest.approx((83, 110)),
    }
    found, learn = drive(motion, 110.0), drive("sweep", 80.0)
    assert np.array_equal(found[:80_000, [X_REF, V_REF]], learn[:-1, [X_REF, V_REF]])
    hold = found[80_700:83_000]
    assert not hold[:, V_REF].any() and np.ptp(hold[:, X_REF]) == 0
    assert np.abs(np.diff(found[:, X_REF])).max() < 0.21e-3  # no jump: 0.2 m/s at most
    assert np.ptp(found[83_000:, X_REF]) > 0.05
    assert found[:80_000, DITHER].any() == (motion == "rich_record")
    assert not found[80_001:, DITHER].any()


def test_other_motions_keep_a_quarter_to_be_judged_by() -> None:
    assert parts_s("rich", 80.0) == {"identification_s": (0, 60), "validation_s": (60, 80)}


def test_a_record_lasts_110_s() -> None:
    assert len(simulate(SimulatedPlant(), "sweep_record", 1).samples) == 110_000
    assert len(simulate(SimulatedPlant(), "standstill", 1).samples) == 80_000
