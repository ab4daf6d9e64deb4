"""Blocks that miss the flow have no say; what nothing excuses stays the fit that it is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtid.diagnose import excuse
from rtid.diagnose import fit as fitting
from rtid.diagnose.excuse import counted, left_over, steady
from rtid.diagnose.fit import Fit, fit, one_pass, prepare
from rtid.diagnose.regression import Estimate
from rtid.diagnose.revision import Revision
from rtid.effects.column import Candidate
from rtid.estimator.state import Weights
from rtid.sim.random_plants import draw
from tests.diagnose.records import record


@pytest.fixture(scope="module")
def leaking() -> Fit:
    """A fit whose maps miss a leak in some of their blocks."""
    model, chunk, _ = record("internal_leakage_laminar", 2e-12)
    return fit(model, chunk, prepare(model, chunk), Revision(), bank=False)


@pytest.mark.long
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


@pytest.fixture(scope="module")
def volumed() -> tuple[Fit, Candidate]:
    """A clean record, 0.7 of whose first chamber's dead volume is to be found; the volume."""
    model, chunk, _ = record()
    small = tuple(replace(c, v0_m3=c.v0_m3 - 0.7 * c.v0_m3 * (c.sign > 0)) for c in model.chambers)
    assumed = replace(model, chambers=small)
    start = prepare(assumed, chunk)
    offered = one_pass(assumed, chunk, start, Revision(), None, True).columns.candidates
    dead = next(c for c in offered if (c.effect, c.where) == ("extra_dead_volume", "a"))
    return fit(assumed, chunk, start, Revision((dead,)), bank=False), dead


def test_a_fitted_volume_weighs_what_is_left_as_a_declared_one(
    volumed: tuple[Fit, Candidate],
) -> None:
    """Its pressures' noise was not counted: no finer grid paid, and a leak was `unknown`."""
    (small, dead), (model, chunk, _) = volumed, record()
    declared = fit(model, chunk, prepare(model, chunk), Revision(), bank=False)
    assert small.held.value(small.column(dead)) == pytest.approx(
        model.chambers[0].v0_m3 - small.declared.chambers[0].v0_m3, rel=0.1
    )
    left, wanted = (np.nanmean(left_over(f).innovation ** 2, axis=0) for f in (small, declared))
    assert left == pytest.approx(wanted, rel=0.05)


def test_a_modulus_is_known_no_better_than_the_volume_beside_it(
    volumed: tuple[Fit, Candidate],
) -> None:
    """They are one trade-off: of 900.6 MPa 888.6 +- 0.4 was told."""
    small, _ = volumed
    sd, least = (np.sqrt(np.diag(c)) for c in (counted(small), small.compliance_cov))
    off = small.compliance - 1.0 / draw(3).beta_pa
    assert np.all(sd >= (1.0 - 1e-12) * least) and least[0] > 2.0 * sd[1]
    assert np.all(np.abs(off) < 3.0 * sd)


@given(st.integers(0, 99), st.integers(0, 4))
def test_beside_what_is_not_known_a_covariance_is_that_of_both(seed: int, others: int) -> None:
    """C_cc = (C_cc - J C_sc) + J C_ss J', whatever the units; a wider size widens it."""
    rng = np.random.default_rng(seed)
    unit = np.exp(rng.uniform(-20.0, 0.0, 2 + others))
    root = rng.normal(size=(2 + others, 2 + others)) * unit[:, None]
    cov, c, s = root @ root.T, slice(0, 2), slice(2, None)
    present: Any = SimpleNamespace(
        estimate=Estimate((1, 2, *range(5, 5 + others)), np.zeros(2 + others), cov, 0.0),
        model=SimpleNamespace(chambers="ab"), weights=SimpleNamespace(compliance=np.ones(2)),
        rho=1.0, spreads=(),
    )  # fmt: skip
    known = cov[c, c] - cov[c, s] @ np.linalg.inv(cov[s, s]) @ cov[s, c]
    wanted, scale = cov[c, c] - known, np.outer(unit[c], unit[c])
    assert excuse._by_sizes(present) / scale == pytest.approx(wanted / scale, abs=1e-6, rel=1e-6)
    present.spreads = tuple((5 + k, unit[2 + k]) for k in range(others))
    more = np.diag(excuse._by_sizes(present)) / np.diag(scale)
    assert np.all(more >= (1.0 - 1e-6) * np.diag(wanted / scale) - 1e-6)


@given(st.integers(0, 99), st.floats(-30.0, 0.0))
def test_neither_way_to_the_noise_is_told_smaller_than_the_other(seed: int, size: float) -> None:
    """On a joystick's steps 1102.2 +- 0.7 MPa were told, of 1112.1, where the other says 1.5."""
    rng = np.random.default_rng(seed)
    first, other = (np.exp(size) * root @ root.T for root in rng.normal(size=(2, 2, 2)))
    wider = excuse._no_less(first, other)
    assert wider.diagonal() == pytest.approx(np.maximum(first.diagonal(), other.diagonal()))
    share = [c[0, 1] / np.sqrt(c[0, 0] * c[1, 1]) for c in (first, wider)]
    assert share[0] == pytest.approx(share[1])
