"""A machine ten times as large, its oil and its flows too, has the same record and the same answer.

Areas, volumes, valves and what is missing grow alike: pressures, positions and commands stay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose.diagnosis import search
from rtid.diagnose.summary import diagnosis
from rtid.effects import catalogue
from rtid.effects.laws import causes
from rtid.effects.magnitude import USUAL_M3, page_for, volume_times
from rtid.effects.record_view import RecordView
from rtid.model import Machine
from tests.diagnose.records import record


def grown(model: Machine, times: float) -> Machine:
    """The machine with every area, volume and flow so many times as large."""
    chambers = tuple(
        replace(c, area_m2=times * c.area_m2, v0_m3=times * c.v0_m3) for c in model.chambers
    )
    edges = tuple(replace(e, rated_q_m3s=times * e.rated_q_m3s) for e in model.edges)
    return replace(model, chambers=chambers, edges=edges)


@pytest.mark.long
def test_a_machine_of_ten_times_the_size_has_the_same_answer() -> None:
    """A hose of 14 pm3/Pa was impossible, and a dead volume was named alone."""
    effect = "hose_compliance"
    model, chunk, held_out = record(effect, 1.5e-12)
    small, large = (search(grown(model, k), chunk, held_out) for k in (1.0, 10.0))
    told = [diagnosis(found) for found in (small, large)]
    assert told[0].verdict == told[1].verdict
    named = [
        {(f.effect, f.where, *sorted(f.cannot_be_told_from)) for f in one.found} for one in told
    ]
    assert named[0] == named[1] and effect in str(named[0])
    np.testing.assert_allclose(large.last.rho, small.last.rho, rtol=0.05)


def test_ranges_grow_with_what_they_are_of() -> None:
    model, chunk, _ = record()
    model = grown(model, 10.0 * USUAL_M3 / (USUAL_M3 * volume_times(model)))
    for cause in causes(RecordView.without_map(model, chunk[:200], np.full(2, 1e-9))):
        page = catalogue()[cause.candidate.effect]
        assert page_for(cause.candidate.law, model) == cause.candidate.law
        if page.size.scale == "volume":
            assert cause.candidate.largest == pytest.approx(10.0 * page.size.high)
    line = page_for(catalogue()["line_dynamics"], model)
    tallest = {p.name: p.high for p in line.parameters}
    assert tallest["volume"] == pytest.approx(5e-2) and tallest["natural_frequency"] == 3000
    assert line.parameters[0].low == pytest.approx(1e5)


def test_a_small_machine_loses_no_size_that_its_page_calls_possible() -> None:
    model, _, _ = record()
    for page in catalogue().values():
        small = page_for(page, grown(model, 1e-3 / volume_times(model)))
        for mine, theirs in zip(small.parameters, page.parameters, strict=True):
            assert mine.low <= theirs.low and mine.high >= theirs.high


def test_a_line_may_have_the_same_share_of_a_larger_chamber() -> None:
    """It ended at 1 L where chambers of 31 L had lines of 4.35 L."""
    model, chunk, _ = record()
    usual = grown(model, 1.0 / volume_times(model))
    ends = []
    for times in (1.0, 10.0):
        view = RecordView.without_map(grown(usual, times), chunk[:200], np.full(2, 1e-9))
        line = next(c for c in causes(view) if c.candidate.effect == "line_dynamics")
        ends.append([line.bounds(k) for k in range(3)])
    np.testing.assert_allclose(ends[1][0], ends[0][0])
    np.testing.assert_allclose(ends[1][1][1], 10.0 * ends[0][1][1])
    np.testing.assert_allclose(ends[1][2][1], 0.1 * ends[0][2][1])
