"""One size over all of a record: asked of its halves beside one map, which leaves them a say."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.diagnose import halves
from rtid.diagnose.consequence import HIDDEN_GAIN, is_stable
from rtid.diagnose.fit import Fit, fit, one_pass, prepare
from rtid.diagnose.halves import between_halves, first_half, in_its_form
from rtid.diagnose.revision import Revision
from rtid.diagnose.standing import with_bank
from rtid.diagnose.trials import Trial, best_by_key, scored
from rtid.diagnose.unseen import has_size
from rtid.estimator.chunk import to_chunk
from rtid.kernels.engine import GAP_FLAG
from rtid.model import Machine
from rtid.plain import FloatArray, Key
from rtid.sim.demand import IDENTIFICATION
from rtid.sim.run import simulate
from tests.campaign.laws import RECORD_S, Case, declared
from tests.diagnose.records import record

LEAK, VOLUME = ("external_leakage_laminar", "a"), ("extra_dead_volume", "a")
AIR = "entrained_air", "both"
MOTIONS = ("sweep", "rich")


def beside(model: Machine, chunk: FloatArray, key: Key) -> tuple[Fit, Trial]:
    """The fit with a cause of the catalogue."""
    first = one_pass(model, chunk, prepare(model, chunk), Revision(), None, True)
    candidate, score = best_by_key(first, scored(first))[key]
    now = fit(model, chunk, first.weights, Revision((candidate,)), bank=False)
    return now, Trial(key, score.gain, now.revision)


def sizes(now: Fit) -> tuple[float, float, float]:
    """Of all of the record, and what its first half has more, with the deviation of that."""
    column = now.column(now.revision.effects[-1])
    return now.held.value(column), *between_halves(now, column)


@pytest.mark.first_of(1)
@pytest.mark.parametrize(
    ("key", "strength", "motion"),
    [(key, size, motion) for key, size in ((LEAK, 1e-12), (VOLUME, 1e-4)) for motion in MOTIONS],
)
def test_what_is_there_all_the_time_has_one_size(key: Key, strength: float, motion: str) -> None:
    """Also of what is stored, the pressures' noise being taken out of either half."""
    model, chunk, _ = record(key[0], strength, 4, motion, key[1])
    size, apart, sd = sizes(beside(model, chunk, key)[0])
    assert abs(apart) < max(3.0 * sd, 0.01 * size)
    assert sd < 0.1 * size


@pytest.mark.long
@pytest.mark.parametrize("strength", [0.01, 0.03])
def test_a_size_that_trades_with_its_own_form_alone_is_one_size(strength: float) -> None:
    """Of air its exponent: 3 % were not confirmed, the moduli told 7 and 11 % low."""
    model, chunk, _ = record(AIR[0], strength, 4, "sweep")
    now, trial = beside(model, chunk, AIR)
    (air,) = now.revision.effects
    in_form, free = in_its_form(now, air), now.estimate
    assert free.sd(now.column(air)) > 5.0 * in_form.sd(now.column(air)), "it does trade"
    assert is_stable(now, trial)
    assert has_size(now, AIR), "whatever its exponent, none is no answer"


def test_a_bank_beside_it_changes_nothing() -> None:
    """`rtid add` asks the halves of a fit that has one, and ended in a ValueError."""
    model, chunk, _ = record(LEAK[0], 1e-12, 4, where="a")
    now = beside(model, chunk[:8000], LEAK)[0]
    banked = with_bank(now, ())
    assert len(banked.regression.prior) > len(now.regression.prior)
    assert sizes(banked) == pytest.approx(sizes(now), rel=1e-3)


def test_what_ends_half_way_has_two() -> None:
    """A machine that leaks, and behind a gap the same one that does not."""
    (model, leaky, _), (_, tight, _) = (record(LEAK[0], v, 4, where="a") for v in (1e-12, 0.0))
    half = len(leaky) // 2
    chunk = np.concatenate([leaky[:half], tight[half:]])
    chunk[half, 1] = int(chunk[half, 1]) | GAP_FLAG
    now, trial = beside(model, chunk, LEAK)
    _, apart, sd = sizes(now)
    assert apart == pytest.approx(1e-12, rel=0.1) and sd < 0.05 * apart
    assert not is_stable(now, trial, is_needed=True)


def of_case(case: Case) -> tuple[Fit, Trial]:
    """The fit of what teaches a machine's maps, with a leak of its chamber b."""
    run = simulate(case.plant, case.motion, case.seed, RECORD_S, case.sensors)
    model = declared(case, run)
    chunk = to_chunk(model, run.samples, 0)
    return beside(model, chunk[chunk[:, 0] < IDENTIFICATION * RECORD_S], (LEAK[0], "b"))


@pytest.mark.campaign
def test_halves_of_a_short_record_on_a_wide_grid_have_their_say() -> None:
    """A seat's leak in 32 s on the grid of `rtid init`: halves with maps of their own had 36
    degrees of freedom and less than none, so that 40 standard deviations were "negligible".
    """
    now, trial = of_case(Case(6101, "choking", "rich_record", "valve_seat_leakage"))
    size, apart, sd = sizes(now)
    assert abs(apart) < 0.1 * size and sd < 0.1 * size
    assert is_stable(now, trial, is_needed=True) and not is_stable(now, trial)


@pytest.mark.long
def test_what_polynomials_miss_alike_in_both_halves_is_no_leak() -> None:
    """A clean sweep that matches without it: one size, 1.2 times the flow, and 174 of chi2."""
    now, trial = of_case(Case(5111, "flow_force", "sweep_record"))
    assert trial.gain > HIDDEN_GAIN and not is_stable(now, trial)


@pytest.mark.parametrize("begins", [0, 300, 900])
def test_half_of_a_column_that_begins_late_is_half_of_its_square(begins: int) -> None:
    """A pump that is asked for more than it gives in the second half alone."""
    column = np.where(np.arange(1000) < begins, 0.0, 1.0)
    is_first = first_half({0: column, 1: -2.0 * column})
    middle = begins + (1000 - begins) // 2 if begins > 500 else 500
    assert is_first.sum() == middle and is_first[:middle].all()


def test_a_half_that_has_nothing_of_an_effect_confirms_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A column that is in one row alone: it was divided by nothing."""
    now, trial = beside(*record(LEAK[0], 1e-12, 4, where="a")[:2], LEAK)
    monkeypatch.setattr(halves, "first_half", lambda volumes: np.zeros(len(volumes[0]), bool))
    assert sizes(now)[1:] == (0.0, np.inf)
    assert not is_stable(now, trial, is_needed=True)
