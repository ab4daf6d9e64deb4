"""The size of an effect whose law is not nature's is no one number, and its interval says so."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.diagnose import spread as spreading
from rtid.diagnose.diagnosis import search
from rtid.diagnose.fit import Fit, fit, one_pass, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.rising import SizesBeside
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
    model, chunk, _ = record(effect, strength, seed, where="" if where == "a-b" else where)
    weights = prepare(model, chunk)
    plain = one_pass(model, chunk, weights, Revision(), None, bank=True)
    leak = best_by_key(plain, scored(plain))[effect, where][0]
    found = fit(model, chunk, weights, with_effect(plain, leak), plain, bank=False)
    return found, found.column(leak)


@pytest.mark.first_of(2)
@pytest.mark.parametrize(
    ("where", "seed"), [("a-b", 6), ("b", 4), ("a-b", 3), ("b", 6), ("a-b", 5)]
)
def test_the_size_over_the_record_is_told_and_not_that_of_what_is_seen(
    where: str, seed: int
) -> None:
    """The gap widens with a pressure, and the maps leave little but its slope: 2 to 12 % more."""
    effect = LEAK if where == "a-b" else "external_leakage_laminar"
    found, column = leaking(effect, 2e-12, where, seed)
    p, other = (found.view.pressure(c) for c in (0, 1)) if where == "a-b" else (
        found.view.pressure(1), np.zeros(found.view.n)
    )  # fmt: skip
    true = float(gap_flow.py_func(2e-12, p, other) @ (p - other) / ((p - other) @ (p - other)))
    known = with_spreads(found)
    size, sd = known.size_of(column), known.sd_of(column)
    assert abs(size - true) < Z95 * sd < 0.02 * size
    assert abs(found.held.value(column) - true) > 5.0 * sd


def test_a_size_goes_with_a_pressure_as_far_as_one_may_believe() -> None:
    """By a prior among the normal equations; and where nothing is known of it, both are free."""
    rng = np.random.default_rng(4)
    y, z, more = rng.standard_normal((3, 40))
    columns = np.stack([y + 2.0 * z + 0.7 * more, z, more + 0.8 * z], axis=1)
    sizes = SizesBeside(columns.T @ columns, {0: 0, 5: 1}, np.zeros(3), np.zeros(3), 1.3)
    for sd in (1e-6, 0.1, 0.5, 1e6):
        gram = sizes.s[1:, 1:] + np.diag([0.0, 1.3 / sd**2])
        size, var, _ = sizes.rising(5, 0, sd)
        assert size == pytest.approx(np.linalg.solve(gram, sizes.s[1:, 0])[0], rel=1e-6)
        assert var == pytest.approx(1.3 * np.linalg.inv(gram)[0, 0], rel=1e-6)
    assert sizes.rising(5, 0, 1e-6)[:2] == pytest.approx(sizes.beside(5), rel=1e-6)
    assert sizes.rising(5, 0, 0.3)[2] > sizes.rising(5, 0, 1e-3)[2]  # it does go with it


def test_of_a_law_that_holds_the_pressures_tell_nothing_more() -> None:
    """A turbulent leak has no size that goes with the pressures."""
    found, column = leaking("external_leakage_turbulent", 2e-9, "a")
    assert with_spreads(found).sd_of(column) < 1.2 * found.sd_of(column)


@pytest.mark.long
@pytest.mark.slow
def test_the_interval_of_a_leak_knows_that_its_gap_widens() -> None:
    """The size that its own flow has over what has taught it, and 3 % less than what is seen."""
    model, chunk, held_out = record(LEAK, 2e-12)
    (found,) = diagnosis(search(model, chunk, held_out)).found
    (size,) = found.parameters.values()
    truth = simulate(hide(draw(3), LEAK, 2e-12), "rich", 3, DURATION_S).truth
    taught = slice(len(chunk))
    drop = truth.signals[taught, P_A] - truth.signals[taught, P_B]
    flow = -truth.extra_m3s[taught, 0]
    true = float(flow @ drop / (drop @ drop))
    print(f"{size.value:.4g} +- {Z95 * size.std:.2g}, true {true:.4g}")
    assert abs(size.value - true) < Z95 * size.std < 0.02 * true


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


def test_what_a_timing_s_first_number_is_unsure_of_its_others_are() -> None:
    """Along the line that the record tells: the damping over the frequency of a spool is known."""
    slope, radps = 0.0226, 0.87
    cov = np.array([[1.0, 0.0, 0.0], [0.0, 4e-4, slope * 4e-4], [0.0, slope * 4e-4, 4e-7]])
    fitted: Any = SimpleNamespace(
        estimate=SimpleNamespace(used=(1, 4, 5), cov=cov),
        revision=SimpleNamespace(timings=(None, None)),
        timing_columns=lambda k: ((4, 5, 6), (7, 8))[k],  # 6 to 8 were not free
    )
    ((column, sd),) = spreading._moved_along(fitted, {4: radps, 7: 1.0})
    assert column == 5
    assert sd == pytest.approx(slope * radps)
