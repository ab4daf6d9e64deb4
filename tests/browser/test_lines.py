"""Lines as the browser draws them: nothing that stands out is lost at any zoom, gaps stay gaps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

import rtid.tell

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

BINS, N = 600, 110_000
SCRIPT = Path(rtid.tell.__file__).parent / "static" / "plots.js"
# a sine over 110 s at 1 kHz with other values at some indices; what is drawn of it
DRAWN = """([changes, low, high]) => {
  const t = Float64Array.from({ length: COUNT }, (_, i) => i / 1000);
  const y = Float32Array.from(t, (at) => Math.sin(2 * Math.PI * 0.3 * at));
  for (const [from, to, value] of changes) y.fill(value === null ? NaN : value, from, to);
  const [seenT, seenY] = plots.between(t, y, low, high, BINS);
  return [[...seenT], [...seenY].map((v) => v === v ? v : null)];
}""".replace("COUNT", str(N)).replace("BINS", str(BINS))


@pytest.fixture(scope="module")
def blank(browser: Browser) -> Iterator[Page]:
    page = browser.new_page()
    page.add_script_tag(content=SCRIPT.read_text("utf-8"))
    yield page
    page.close()


def drawn(
    page: Page, changes: list[tuple[int, int, float | None]], low: float = 0.0, high: float = 110.0
) -> tuple[np.ndarray, np.ndarray]:
    t, y = page.evaluate(DRAWN, [changes, low, high])
    return np.array(t), np.array(y, float)


@pytest.mark.parametrize("value", [5.0, -5.0])
@pytest.mark.parametrize("at", [0, 1, 183, 54_321, N - 2, N - 1])
def test_a_spike_of_one_sample_is_drawn_at_the_whole_record(
    blank: Page, at: int, value: float
) -> None:
    t, y = drawn(blank, [(at, at + 1, value)])
    assert (at / 1000, value) in zip(t, y, strict=True)
    assert len(y) <= 2 * BINS + 2


def test_every_spike_of_many_is_drawn(blank: Page) -> None:
    at = np.arange(40) * 2700 + np.random.default_rng(0).integers(0, 2000, 40)  # a bin apart
    t, y = drawn(blank, [(int(k), int(k) + 1, 5.0 + i) for i, k in enumerate(at)], 20.0, 90.0)
    inside = {float(k) / 1000 for k in at if 20.0 <= k / 1000 <= 90.0}
    assert inside <= set(t[y >= 5.0])
    assert len(inside) > 20


@pytest.mark.parametrize(("low", "high"), [(10.0, 11.0), (55.0, 80.0), (0.0, 110.0), (-5.0, 200.0)])
def test_what_is_seen_spans_the_window(blank: Page, low: float, high: float) -> None:
    t, _ = drawn(blank, [], low, high)
    assert t[0] <= max(low, 0.0)
    assert t[-1] >= min(high, 109.999)
    assert np.all(np.diff(t) > 0)


def test_a_short_window_shows_every_sample(blank: Page) -> None:
    t, y = drawn(blank, [], 20.0, 20.5)
    assert t == pytest.approx(np.arange(19_999, 20_502) / 1000)
    assert y == pytest.approx(np.sin(2 * np.pi * 0.3 * t), abs=1e-6)


def test_missing_values_break_the_line_and_do_not_hide_their_neighbours(blank: Page) -> None:
    t, y = drawn(blank, [(40_000, 41_000, None), (39_999, 40_000, 7.0), (41_000, 41_001, -7.0)])
    assert 7.0 in y
    assert -7.0 in y
    assert np.isnan(y[(t >= 40.0) & (t < 41.0)]).all()
    one = drawn(blank, [(40_000, 40_001, None)])[1]
    assert np.isnan(one).sum() == 1  # a gap of one sample is seen at the whole record


def test_a_window_beside_the_record_shows_nothing_of_it(blank: Page) -> None:
    t, _ = drawn(blank, [], 200.0, 300.0)
    assert len(t) <= 1


def test_two_breaks_in_a_bin_are_both_kept(blank: Page) -> None:
    """Of a run that begins anew right behind a gap the gap itself was joined."""
    t, y = drawn(blank, [(40_000, 40_001, None), (40_001, 40_003, 9.0), (40_003, 40_004, None)])
    first = int(np.flatnonzero(y == 9.0)[0])
    assert np.isnan(y[first - 1]) and t[first - 1] == 40.0
    assert np.isnan(y[first + 1 :][t[first + 1 :] <= 40.003]).any()
