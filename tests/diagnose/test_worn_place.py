"""A worn place is looked for in shares of the way that the record covers, whatever the stroke."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.effects.column import by_equation
from rtid.effects.law import placed_on
from rtid.effects.page import effect
from rtid.effects.record_view import RecordView
from tests.diagnose.records import record

PAGE = effect("position_dependent_leakage")


@pytest.mark.parametrize("way_m", [0.05, 0.3, 1.3, 4.0])
def test_widths_and_places_are_those_of_the_way(way_m: float) -> None:
    """Half widths were 30 and 60 mm: of one of 260 mm in 1.3 m the fit ended at 46."""
    model, chunk, _ = record()
    part = chunk[:200].copy()
    part[:, 2 + model.column(model.position)] = np.linspace(0.1, 0.1 + way_m, len(part))
    view = RecordView.without_map(model, part, np.full(len(model.chambers), 1e-9))
    cause = by_equation(view, placed_on(view, PAGE)[0])
    places, widths = cause.axes
    assert places == pytest.approx(np.linspace(0.1, 0.1 + way_m, 5))
    least = PAGE.parameters[-1].low
    assert widths == pytest.approx(np.maximum(least, way_m * np.array([0.04, 0.1, 0.2, 0.4])))
    for k, axis in enumerate(cause.axes):
        low, high = cause.bounds(k)
        assert low <= min(axis) and max(axis) <= high
    assert len(cause.shapes) == 20
