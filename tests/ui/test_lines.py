"""Lines as the page gets them: in bins that lose neither spike nor gap, whole from close by."""

from __future__ import annotations

import numpy as np
import pytest
from bokeh.plotting import figure

from rtid.tell.charts.lines import BINS, ROWS, Lines, Part, joined, thinned, unbroken

LONG = 600_000  # ten minutes at 1 kHz


def test_parts_and_gaps_are_not_joined_by_a_line() -> None:
    t = np.linspace(0.0, 0.999, 1000)
    t[600:] += 3.0
    parts = (t, {"y": np.ones(1000)}), (t + 10.0, {"y": np.full(1000, 2.0)})
    found = joined(piece for part in parts for piece in unbroken(*part))
    assert np.all(np.diff(found["t"]) >= 0)
    broken = np.flatnonzero(np.isnan(found["y"]))
    assert found["t"][broken].tolist() == [t[599], t[-1], t[599] + 10, t[-1] + 10]
    assert np.isfinite(found["y"]).sum() == 2000


def test_nothing_is_a_line_of_nothing() -> None:
    assert {name: len(y) for name, y in joined([]).items()} == {"t": 0}
    empty = np.empty(0)
    assert unbroken(empty, {"y": empty}) == []


def test_only_what_is_drawn_is_sent_and_no_wider_than_needed() -> None:
    lines, made, values = Lines(), figure(), np.arange(5.0)
    lines.add(made, "a", "#0072b2", 1.0)
    lines.show([(values, {"a": values.__getitem__, "b": values.__getitem__})])
    assert set(lines.whole.data) == {"t", "a"} and lines.whole.name is None
    assert lines.whole.data["a"].dtype == np.float32
    assert lines.whole.data["t"].dtype == np.float64
    drawn = made.renderers[0].data_source
    assert drawn.tags == [lines.whole, "a", lines.detail]


def long_record(changes: dict[int, float]) -> Part:
    """A sine of ten minutes with other values at some samples."""
    t = np.arange(LONG) / 1000
    y = np.sin(0.3 * t)
    y[list(changes)] = list(changes.values())
    return t, {"y": y.__getitem__}


def shown(part: Part) -> Lines:
    lines = Lines()
    lines.add(figure(), "y", "#0072b2", 1.0)
    lines.show([part])
    return lines


def test_a_long_record_is_sent_in_bins_and_loses_no_spike() -> None:
    """Of one sample each, at the ends of the record and anywhere: at its time within a bin."""
    rng = np.random.default_rng(0)
    at = [0, LONG - 1, *(20_000 * np.arange(1, 29) + rng.integers(0, 9_000, 28)).tolist()]
    spikes = {k: (5.0 + n) * (-1) ** n for n, k in enumerate(at)}
    sent = shown(long_record(spikes)).whole
    assert len(sent.data["t"]) == BINS * ROWS + 1 and sent.name == "thinned"
    assert np.all(np.diff(sent.data["t"]) >= 0)
    for k, value in spikes.items():
        there = sent.data["t"][sent.data["y"] == np.float32(value)]
        assert len(there) and abs(there[0] - k / 1000) <= LONG / BINS / 1000


@pytest.mark.parametrize("seed", range(5))
def test_bins_keep_the_extremes_of_any_line_and_every_gap(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, bins = int(rng.integers(400, 3000)), 100
    y = rng.normal(size=n)
    y[rng.integers(0, n, 9)] = np.nan
    t, sent = thinned(np.arange(float(n)), {"y": y}, bins)
    rows = sent["y"].reshape(bins, ROWS)
    ends = np.arange(bins + 1) * n // bins
    for k, piece in enumerate(np.split(y, ends[1:-1])):
        assert np.nanmin(rows[k]) == np.nanmin(piece) and np.nanmax(rows[k]) == np.nanmax(piece)
        assert np.isnan(rows[k]).any() == np.isnan(piece).any()
        assert np.all(t.reshape(bins, ROWS)[k] >= ends[k])


def test_no_bin_reaches_across_a_gap() -> None:
    """A line from one part of the record to the next would be a measurement that nobody made."""
    rng, t, values = np.random.default_rng(1), np.arange(20_000.0), np.ones(20_000)
    starts = np.sort(rng.uniform(0, 1e6, 7)) + np.arange(7) * 1e5
    lines = Lines()
    lines.add(figure(), "y", "#0072b2", 1.0)
    lines.show([(t + start, {"y": values.__getitem__}) for start in starts])
    sent = lines.whole.data
    steps = np.diff(sent["t"])
    is_far = steps > 100.0
    assert is_far.sum() == 6 and np.isnan(sent["y"][:-1][is_far]).all()
    assert np.isnan(sent["y"]).sum() == 7


def test_what_a_page_zooms_to_is_sent_sample_by_sample() -> None:
    lines = shown(long_record({300_500: 9.0}))
    lines.zoom(300.0, 301.0)
    sent = lines.detail
    assert sent.name is None and len(sent.data["t"]) == 1003  # one before it, one break
    assert sent.data["t"][np.nanargmax(sent.data["y"])] == 300.5
    lines.show([long_record({300_500: 7.0})])  # another revision: the same window
    assert np.nanmax(sent.data["y"]) == 7.0


def test_a_report_has_its_lines_whole() -> None:
    lines = Lines(is_whole=True)
    lines.add(figure(), "y", "#0072b2", 1.0)
    lines.show([long_record({})])
    assert len(lines.whole.data["t"]) == LONG + 1 and lines.whole.name is None
