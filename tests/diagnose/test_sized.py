"""An oil that stiffens is fitted about its own size, and what it is known to counts that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose.fit import fit, one_pass, prepare
from rtid.diagnose.fitted_sizes import parameters
from rtid.diagnose.revision import Revision
from rtid.diagnose.sized import about_its_size, physical, physical_sd
from rtid.diagnose.spread import with_spreads
from rtid.diagnose.trials import best_by_key, scored, with_effect
from rtid.effects import effect
from rtid.effects.column import of_page
from rtid.sim.random_plants import draw
from tests.diagnose.records import record

STIFFENING = 2.7e-8  # 1/Pa: three times the usual oil's, which the page begins at


def test_a_law_is_put_about_a_size_and_any_other_stays() -> None:
    oil, leak = effect("oil_stiffening"), effect("external_leakage_laminar")
    assert oil.inner_size == 8e-9 and oil.at_size(STIFFENING).inner_size == STIFFENING
    assert oil.at_size(8e-9) == oil
    assert leak.inner_size == 0.0 and leak.at_size(STIFFENING) is leak


def test_a_size_far_from_the_usual_one_is_found_and_the_moduli_with_it() -> None:
    """Of 1.29e-8 1.15e-8 was told, and moduli 1 % off at 30 deviations."""
    model, chunk, _ = record("oil_stiffening", STIFFENING, 3, "rich_record")
    candidate = of_page(effect("oil_stiffening"), "both")
    found = fit(model, chunk, prepare(model, chunk), Revision((candidate,), ()), bank=False)
    found = with_spreads(found)
    (inner,) = found.revision.effects
    assert inner.law.inner_size == pytest.approx(STIFFENING, rel=0.05)
    (size,) = parameters(found, candidate.key).values()
    assert size.value == pytest.approx(STIFFENING, abs=2.5 * size.std)
    rows_alone = replace(found, spreads=()).sd_of(found.column(inner))
    assert 1.05 < found.sd_of(found.column(inner)) / rows_alone < 1.6, "1 / (1 - dc/ds)"
    off = found.compliance * draw(3).constants.beta_pa - 1.0
    assert np.abs(off).max() < 2e-3
    value = found.held.value(found.column(inner))
    assert about_its_size(found, inner, 0.5 * value).law.inner_size < 0.6 * STIFFENING


def test_a_volume_is_known_no_better_than_the_modulus_that_it_trades_off_with() -> None:
    """Drawn from the fit's covariance, the volume that belongs to each pair scatters as told."""
    model, chunk, _ = record("extra_dead_volume", 4e-4, 3, "sweep_record")
    plain = one_pass(model, chunk, prepare(model, chunk), Revision(), None, bank=True)
    volume = best_by_key(plain, scored(plain))["extra_dead_volume", "a"][0]
    known = one_pass(model, chunk, plain.weights, with_effect(plain, volume), plain, bank=False)
    estimate, column = known.estimate, known.column(volume)
    at = [estimate.used.index(1), estimate.used.index(column)]
    mean = known.held.value(1), known.held.value(column)
    cov = max(1.0, known.rho) * estimate.cov[np.ix_(at, at)]
    near = 0.1  # of the deviations: to first order, as what is told
    soft, size = np.random.default_rng(5).multivariate_normal(mean, near**2 * cov, 20_000).T
    told_ = physical_sd(known, volume)
    assert told_ == pytest.approx(float(np.std(size / soft)) / near, rel=0.03)
    assert told_ > 1.2 * abs(physical(known, volume, 1.0)) * known.sd_of(column)
