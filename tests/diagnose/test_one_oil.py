"""One oil boils out in both chambers: one coefficient and one pressure, where both get there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.effects.column import Cause
from rtid.effects.laws import causes
from rtid.effects.laws.storage import softness
from rtid.effects.record_view import RecordView
from rtid.effects.terms import terms_of
from tests.diagnose.records import record


def cavitations() -> tuple[RecordView, dict[str, Cause]]:
    model, chunk, _ = record()
    view = RecordView.without_map(model, chunk[:8000], np.full(2, 1e-9))
    found = [c for c in causes(view) if c.candidate.effect == "cavitation"]
    return view, {c.candidate.where: c for c in found}


def test_gas_that_comes_out_in_both_chambers_is_one_cause() -> None:
    """Each chamber alone took 3 % of what was missing, and nothing was named."""
    view, of = cavitations()
    p_sat = 1.1 * max(float(np.quantile(view.pressure(c), 0.1)) for c in (0, 1))
    both = of["both"].column((p_sat,))
    for c, chamber in enumerate(view.model.chambers):
        np.testing.assert_array_equal(both[c], of[chamber.name].column((p_sat,))[c])
        assert np.any(both[c])


def test_gas_that_comes_out_in_one_chamber_alone_is_that_ones() -> None:
    view, of = cavitations()
    least = sorted(float(view.pressure(c).min()) for c in (0, 1))
    p_sat = 0.5 * (least[0] + least[1])
    assert not any(np.any(volume) for volume in of["both"].column((p_sat,)).values())
    both = replace(of["both"].candidate, shape=(p_sat,))
    assert not any(np.any(soft) for soft in softness(view, both).values())


def test_a_search_begins_at_pressures_of_the_record_too() -> None:
    view, of = cavitations()
    page = of["a"].candidate.law.shapes[0]
    for share in page.quantiles:
        at = float(np.clip(np.quantile(view.pressure(0), share), page.low, page.high))
        assert any(start == pytest.approx(at) for start in of["a"].axes[0])


def test_it_runs_live_in_both_chambers() -> None:
    view, of = cavitations()
    candidate = replace(of["both"].candidate, shape=(2e6,))
    terms = terms_of(view.model, np.full(2, 1e-9), candidate, 1e-8)
    assert sorted(name for term in terms for name, _ in term.signs) == ["a", "b"]
