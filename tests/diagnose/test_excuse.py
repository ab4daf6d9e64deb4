"""Blocks that miss the flow have no say; what nothing excuses stays the fit that it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose import excuse
from rtid.diagnose import fit as fitting
from rtid.diagnose.excuse import left_over, steady
from rtid.diagnose.fit import Fit, fit, one_pass, prepare
from rtid.diagnose.revision import Revision
from rtid.estimator.state import Weights
from tests.diagnose.records import record


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


def test_a_fitted_volume_weighs_what_is_left_as_a_declared_one() -> None:
    """Its pressures' noise was not counted: no finer grid paid, and a leak was `unknown`."""
    model, chunk, _ = record()
    small = tuple(replace(c, v0_m3=c.v0_m3 - 0.7 * c.v0_m3 * (c.sign > 0)) for c in model.chambers)
    assumed = replace(model, chambers=small)
    start = prepare(assumed, chunk)
    offered = one_pass(assumed, chunk, start, Revision(), None, True).columns.candidates
    dead = next(c for c in offered if (c.effect, c.where) == ("extra_dead_volume", "a"))
    volumed = fit(assumed, chunk, start, Revision((dead,)), bank=False)
    declared = fit(model, chunk, prepare(model, chunk), Revision(), bank=False)
    assert volumed.held.value(volumed.column(dead)) == pytest.approx(
        model.chambers[0].v0_m3 - small[0].v0_m3, rel=0.1
    )
    left, wanted = (np.nanmean(left_over(f).innovation ** 2, axis=0) for f in (volumed, declared))
    assert left == pytest.approx(wanted, rel=0.05)
