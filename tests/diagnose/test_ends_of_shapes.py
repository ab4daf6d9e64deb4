"""A shape at an end of its range has a way back, where its derivative points there."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rtid.diagnose.fit import fit
from rtid.diagnose.standing import stand
from rtid.diagnose.trials import best_by_key, scored, with_effect
from rtid.effects.laws import cause_of
from tests.diagnose.records import record

AIR = "entrained_air", "both"


@pytest.mark.long
def test_air_that_begins_at_an_end_of_its_exponents_comes_back() -> None:
    """It stood there for good, and was refuted for it: 1 % of air was `unknown` at rho 156.

    One that points out is held where it is, and is no free number.
    """
    model, chunk, held_out = record("entrained_air", 0.01)
    present = stand(model, chunk, held_out).fit
    air = best_by_key(present, scored(present))[AIR][0]
    ends = cause_of(present.view, air).bounds(0)
    found = []
    for end in ends:
        begun = with_effect(present, replace(air, shape=(end,)))
        ended = fit(model, chunk, present.weights, begun, present, bank=False)
        found.append(ended.revision.effects[-1].shape[0])
        assert ended.rho < 1.3
    assert found[0] == pytest.approx(found[1], rel=0.02)
    assert ends[0] < found[0] < ends[1]

    other = best_by_key(present, scored(present))["entrained_air", "b"][0]
    low = with_effect(present, replace(other, shape=(ends[0],)))
    held = fit(model, chunk, present.weights, low, present, bank=False)
    assert held.revision.effects[-1].shape == (ends[0],)
    assert held.shapes and not held.shape_columns(held.revision.effects[-1])


@pytest.mark.long
def test_a_relief_valve_may_open_at_any_pressure_of_the_record() -> None:
    """One that was open for 97 % of it stood at the end of an axis, and two leaks mended that."""
    present = stand(*record("entrained_air", 0.01)).fit
    relief = best_by_key(present, scored(present))["relief_valve", "a"][0]
    cause, pressure = cause_of(present.view, relief), present.view.pressure(0)
    low, high = cause.bounds(0)
    assert low == pytest.approx(pressure.min(), abs=0.05e6) and low < cause.axes[0][0]
    assert high == pytest.approx(pressure.max(), abs=0.05e6)
