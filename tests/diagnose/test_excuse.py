"""Blocks that miss the flow have no say; what nothing excuses stays the fit that it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose import excuse
from rtid.diagnose import fit as fitting
from rtid.diagnose.equations import square_of
from rtid.diagnose.excuse import left_over, steady
from rtid.diagnose.fit import Fit, fit, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.standing import with_bank
from rtid.diagnose.trials import scored, with_effect
from rtid.effects.law import lagged
from rtid.estimator.state import Weights
from tests.diagnose.records import noisy, record


@pytest.fixture(scope="module")
def leaking() -> Fit:
    """A fit whose maps miss a leak in some of their blocks."""
    model, chunk, _ = record("internal_leakage_laminar", 2e-12)
    return fit(model, chunk, prepare(model, chunk), Revision(), bank=False)


def test_blocks_that_miss_the_flow_are_excused(leaking: Fit) -> None:
    assert leaking.rho > 2.0
    assert steady(leaking).weights.missed.any() and steady(leaking).rho < leaking.rho


def test_where_nothing_is_excused_no_pass_is_made(
    leaking: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What comes and goes too fast to be a block's has no rate, and the fit would be the same."""

    def by_nothing(_model: object, _chunk: object, weights: Weights, *_: object) -> Weights:
        return replace(weights, missed=np.zeros_like(weights.missed))

    monkeypatch.setattr(excuse, "excusing", by_nothing)
    monkeypatch.setattr(excuse, "fit", lambda *_, **__: pytest.fail("fitted again"))
    same = steady(leaking)
    assert same.held is leaking.held and same.rest is not None
    assert steady(same) is not same and steady(same).rest is same.rest


def test_what_is_left_of_a_long_record_is_not_kept(
    leaking: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    rest = left_over(leaking)
    kept = leaking.leaving(rest)
    assert kept.rest is rest and left_over(kept) is rest and kept.sent is leaking.sent
    monkeypatch.setattr(fitting, "LONG", len(leaking.chunk))
    assert leaking.leaving(rest) is leaking


@pytest.mark.parametrize(
    ("effect", "size", "seed"), [("entrained_air", 0.05, 3), ("extra_dead_volume", 1e-3, 4)]
)
def test_what_is_stored_moves_rows_by_the_noise_of_its_pressure(
    effect: str, size: float, seed: int
) -> None:
    """chi2 of all samples is what the fit's own rows leave, within the error of a chi2.

    By the noise of a model that stores nothing else it was 109,000 and 27,000 too large, and by
    that of a dead volume that follows at once, not by a port lag of 2.5 ms, 19,000 too small.
    """
    model, chunk, _ = record(effect, size, seed)
    first = with_bank(fit(model, chunk, prepare(model, chunk), Revision(), bank=False))
    of_name = [pair for pair in scored(first) if pair[0].key == (effect, "both")]
    best, _ = max(of_name, key=lambda pair: pair[1].gain)
    stored = fit(model, chunk, first.weights, with_effect(first, best), first, bank=False)
    squares = left_over(stored).innovation ** 2
    unknowns, excess = stored.regression.rows - stored.regression.dof, stored.held.sse
    expected = excess - stored.regression.dof - unknowns
    error = float(np.sqrt(2.0 * np.isfinite(squares).sum()))
    assert np.nansum(squares - 1.0) == pytest.approx(expected, abs=3.0 * error)


def test_what_follows_late_takes_up_less_of_a_noise() -> None:
    """Of a white noise, in rows of one position and of ten."""
    noise, stored = noisy(np.random.default_rng(1), 400_000), [(1.0, 0.0), (5.0, 2.4)]
    taken = np.sum([size * lagged(noise, 1.0, samples) for size, samples in stored], axis=0)
    for means in (1, 10):
        rows = taken.reshape(-1, means).mean(axis=1)
        (square,) = square_of([(np.full(1, size), samples) for size, samples in stored], means)
        assert means * np.var(rows) == pytest.approx(square, rel=0.03)
        assert square < 0.9 * 36.0
