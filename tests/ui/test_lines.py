"""Lines as the page gets them: whole, broken between the parts of a record and at its gaps."""

from __future__ import annotations

import numpy as np
from bokeh.plotting import figure

from rtid.tell.charts.lines import Lines, joined


def test_parts_and_gaps_are_not_joined_by_a_line() -> None:
    t = np.linspace(0.0, 0.999, 1000)
    t[600:] += 3.0
    found = joined([(t, {"y": np.ones(1000)}), (t + 10.0, {"y": np.full(1000, 2.0)})])
    assert np.all(np.diff(found["t"]) >= 0)
    broken = np.flatnonzero(np.isnan(found["y"]))
    assert found["t"][broken].tolist() == [t[599], t[-1], t[599] + 10, t[-1] + 10]
    assert np.isfinite(found["y"]).sum() == 2000


def test_nothing_is_a_line_of_nothing() -> None:
    assert {name: len(y) for name, y in joined([]).items()} == {"t": 0}
    empty = np.empty(0)
    assert len(joined([(empty, {"y": empty})])["t"]) == 0


def test_only_what_is_drawn_is_sent_and_no_wider_than_needed() -> None:
    lines, made = Lines(), figure()
    lines.add(made, "a", "#0072b2", 1.0)
    lines.show([(np.arange(5.0), {"a": np.arange(5.0), "b": np.arange(5.0)})])
    assert set(lines.whole.data) == {"t", "a"}
    assert lines.whole.data["a"].dtype == np.float32
    assert lines.whole.data["t"].dtype == np.float64
    drawn = made.renderers[0].data_source
    assert drawn.tags == [lines.whole, "a"]
