"""Where, when, how fast and which way something is left: words, bands and their picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.compare.comparison import Comparison, Intervals
from rtid.compare.dependence import Dependence, against_signals, by_direction, over_time
from rtid.diagnose import remains
from rtid.diagnose.remains import BANDS_HZ, Remainder, _how_fast, _way, _when, bands, remainder
from rtid.diagnose.standing import fitted
from rtid.sim.declare import declared_model
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.tell.charts.evidence import left_over
from rtid.tell.stills import draw
from tests.diagnose.records import record

RATE_HZ = 50.0


def over(signal: str, low: list[float], rms: list[float]) -> Dependence:
    """Bins of one chamber with these sizes."""
    edges, size, n = np.array(low), np.array(rms)[:, None], len(low)
    rows, nothing = np.full(n, 100), np.zeros((n, 1))
    return Dependence(
        signal, "s", edges, edges + 1.0, edges + 0.5, nothing, nothing, size, rows, np.zeros(1)
    )


@pytest.mark.parametrize("hz", [0.1, 0.4, 1.7, 6.0, 20.0])
def test_a_wave_lies_in_its_band_and_nothing_is_lost(hz: float) -> None:
    t_s = np.arange(0.0, 60.0, 1.0 / RATE_HZ)
    t_s = t_s[(t_s < 20.0) | (t_s > 23.0)]  # a gap is no jump
    wave = np.sin(2 * np.pi * hz * t_s)[:, None]
    size = bands(t_s, wave)[:, 0]
    k = int(np.searchsorted(BANDS_HZ, hz)) - 1
    assert int(np.argmax(size)) == k
    assert size[k] ** 2 > 0.9 * 0.5
    assert np.sum(size**2) == pytest.approx(np.mean(wave**2), rel=1e-9)


def test_the_frequency_is_that_of_what_is_beyond_the_noise() -> None:
    noise = np.full(len(BANDS_HZ) - 1, 1.0)
    rms = noise.copy()
    rms[3] = 3.0
    assert _how_fast(rms, noise) == ", 100 % of it at 1 to 2 Hz"
    rms[[0, 5]] = 3.0
    assert _how_fast(rms, noise) == ", at no frequency of its own"
    assert _how_fast(noise, noise) == ", at no frequency of its own"


def test_a_span_and_a_direction_are_named_where_they_stand_out() -> None:
    assert _when(over("time", [0.0, 1.0, 2.0, 3.0, 4.0], [1, 1, 9, 1, 1]), 0) == (
        ", most from 2 to 3 s"
    )
    assert _when(over("time", [0.0, 1.0, 2.0], [1, 1.5, 1]), 0) == ""
    ways = over("direction", [-np.inf, -0.1, 0.1], [1.0, 0.5, 3.0])
    assert _way(ways, 0) == ", above all while extending"
    assert _way(replace(ways, rms_m3s=np.ones((3, 1))), 0) == ""


def test_the_picture_has_a_place_for_each_of_them() -> None:
    time, ways = (
        over("time", [0.0, 1.0], [1, 2]),
        over("direction", [-np.inf, -0.1, 0.1], [1, 2, 3]),
    )
    signal = replace(over("x", [0.0, 1.0], [1, 2]), explained=np.array([0.4]))
    sizes = np.ones((len(BANDS_HZ) - 1, 1))
    chart = left_over(Remainder("said", ("a",), (signal,), time, ways, sizes, 0.1 * sizes))
    panels = [panel for row in chart.panels for panel in row]
    assert [p.title for p in panels[:3]] == [
        "over x: explains 40 %", "over time: explains 0 %", "over direction: explains 0 %",
    ]  # fmt: skip
    assert panels[3].ticks[0] == "0.25" and panels[3].ticks[3:] == ("2", "4", "8", "more")
    assert chart.caption == "said"
    assert draw(chart).axes


def test_rows_too_few_for_any_bin_have_words_and_a_picture() -> None:
    """A record of which the map was known over nine rows ended in a traceback."""
    model, part = declared_model(SimulatedPlant()), few_rows()
    time, ways = over_time(part), by_direction(model, part)
    assert not len(time.low)
    assert _when(time, 0) == ""
    signals = tuple(against_signals(model, part))
    assert all(np.isfinite(of.explained).all() for of in (*signals, time, ways))
    sizes = np.ones((len(BANDS_HZ) - 1, 2))
    assert draw(left_over(Remainder("", ("a", "b"), signals, time, ways, sizes, sizes))).axes


def few_rows() -> Comparison:
    """Fewer rows than a bin over time needs, of a machine with two chambers."""
    model, rng = declared_model(SimulatedPlant()), np.random.default_rng(1)
    n, values = 7, rng.standard_normal((7, 4))
    none = np.empty((0, 2))
    empty = Intervals(np.empty(0), np.empty((0, 4), np.int64), none, none, none)
    return Comparison(
        name="", t_s=np.linspace(7.0, 12.0, n), measured_m3s=values[:, :2],
        modelled_m3s=values[:, 2:], cell=np.zeros((n, 4), np.int64), shares={}, rho=np.ones(2),
        signals=rng.standard_normal((n, len(model.signals))), intervals=empty,
    )  # fmt: skip


def test_a_record_whose_map_is_hardly_known_is_described_by_all_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whole seconds of it instead of nine rows."""
    present = fitted(*record("", 0.0, 3, "sweep")[:2])
    monkeypatch.setattr(remains, "can_judge", lambda _: True)
    known = remainder(present)
    monkeypatch.setattr(remains, "can_judge", lambda _: False)
    whole = remainder(present)
    assert known is not None and whole is not None
    assert whole.time.rows.sum() > known.time.rows.sum()
