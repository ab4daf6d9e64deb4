"""The size of an effect whose law is not nature's is no one number, and its interval says so."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.diagnose import spread as spreading
from rtid.diagnose.diagnosis import search
from rtid.diagnose.fit import Fit, fit, one_pass, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.spread import spread, with_spreads
from rtid.diagnose.standing import with_bank
from rtid.diagnose.summary import diagnosis
from rtid.diagnose.trials import best_by_key, scored, with_effect
from rtid.plain import Key
from rtid.sim.extra_flows import gap_flow
from rtid.sim.hidden import hide
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate
from rtid.sim.sensing import P_A, P_B
from rtid.units import UNIFORM, Z95
from tests.diagnose.records import DURATION_S, record

LEAK = "internal_leakage_laminar"


def test_the_spread_is_what_sizes_differ_by_beyond_their_noise() -> None:
    rng, t = np.random.default_rng(1), 0.5
    mix = np.tril(rng.uniform(0.2, 1.0, (4, 4))) * 0.2
    drawn = rng.standard_normal((2000, 4)) @ mix.T + t * rng.standard_normal((2000, 4))
    squares = [spread(3.0 + sizes, mix @ mix.T) ** 2 for sizes in drawn]
    assert np.sqrt(np.mean(squares)) == pytest.approx(t, rel=0.1)
    alike = [spread(3.0 + mix @ rng.standard_normal(4), mix @ mix.T) for _ in range(500)]
    assert np.median(alike) < 0.1 * t


def leaking(effect: str, strength: float, where: str, seed: int = 3) -> tuple[Fit, int]:
    """A machine that leaks, fitted with the leak, and the column of that."""
    model, chunk, _ = record(effect, strength, seed)
    weights = prepare(model, chunk)
    plain = one_pass(model, chunk, weights, Revision(), None, bank=True)
    leak = best_by_key(plain, scored(plain))[effect, where][0]
    found = fit(model, chunk, weights, with_effect(plain, leak), plain, bank=False)
    return found, found.column(leak)


@pytest.mark.first_of(1)
@pytest.mark.parametrize(("seed", "is_far"), [(3, True), (4, True), (5, False)])
def test_a_size_is_as_far_from_that_over_the_record_as_it_says(seed: int, is_far: bool) -> None:
    """The gap widens with the mean pressure, and what tells the leak is not all of its flow."""
    found, column = leaking(LEAK, 2e-12, "a-b", seed)
    size, (a, b) = found.held.value(column), (found.view.pressure(c) for c in (0, 1))
    true = float(gap_flow.py_func(2e-12, a, b) @ (a - b) / ((a - b) @ (a - b)))
    assert abs(size - true) < Z95 * with_spreads(found).sd_of(column) < 0.12 * size
    assert not is_far or abs(size - true) > 5.0 * found.sd_of(column)


def test_what_is_no_clear_difference_widens_no_interval() -> None:
    assert spreading._beyond(1.9, 1.0) == 0.0 == spreading._beyond(0.0, 0.0)
    assert spreading._beyond(-5.0, 16.0) == 0.0 and spreading._beyond(-5.0, 4.0) > 4.0
    assert spreading._beyond(3.0, -1e-9) == 3.0  # rounding of two variances that are equal


def test_of_a_law_that_holds_the_pressures_tell_nothing_more() -> None:
    """A turbulent leak has no size that goes with the pressures."""
    found, column = leaking("external_leakage_turbulent", 2e-9, "a")
    assert with_spreads(found).sd_of(column) < 1.2 * found.sd_of(column)


@pytest.mark.long
@pytest.mark.slow
def test_the_interval_of_a_leak_knows_that_its_gap_widens() -> None:
    """The size that its own flow has over the record; the noise alone gave an interval of 0.1 %."""
    model, chunk, held_out = record(LEAK, 2e-12)
    (found,) = diagnosis(search(model, chunk, held_out)).found
    (size,) = found.parameters.values()
    truth = simulate(hide(draw(3), LEAK, 2e-12), "rich", 3, DURATION_S).truth
    drop, flow = truth.signals[:, P_A] - truth.signals[:, P_B], -truth.extra_m3s[:, 0]
    true = float(flow @ drop / (drop @ drop))
    print(f"{size.value:.4g} +- {Z95 * size.std:.2g}, true {true:.4g}")
    assert abs(size.value - true) < Z95 * size.std < 0.1 * true


@pytest.mark.long
def test_what_nobody_is_told_of_widens_what_it_moves() -> None:
    """A relief valve beside a leak whose gap widens: with it the leak is another one."""
    model, chunk, _ = record(LEAK, 2e-12)
    first = with_bank(fit(model, chunk, prepare(model, chunk), Revision(), bank=False))
    best = best_by_key(first, scored(first))
    leak, valve = (best[key][0] for key in ((LEAK, "a-b"), ("relief_valve", "a")))
    alone, both = (
        fit(model, chunk, first.weights, Revision(effects), bank=False)
        for effects in ((leak,), (leak, valve))
    )
    known, told = (
        dict(with_spreads(both, unnamed).spreads)[both.column(leak)]
        for unnamed in (frozenset[Key](), frozenset({valve.key}))
    )
    moved = both.held.value(both.column(leak)) - alone.held.value(alone.column(leak))
    assert told == pytest.approx(np.hypot(known, moved / UNIFORM), rel=0.1) and told > known
