"""Two causes at once: which late command it is, and what few held-out moments may refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from firmware_bridge.samples import GAP
from rtid.diagnose import admission
from rtid.diagnose.admission import is_seen_to_harm, leaves_more
from rtid.diagnose.fit import Fit, fit, prepare
from rtid.diagnose.held_again import held_again
from rtid.diagnose.regression import LIMIT_SD
from rtid.diagnose.residual import Residual
from rtid.diagnose.revision import Revision
from rtid.diagnose.trials import AcceptedEffect, TrialState, best_by_key, scored
from rtid.effects.laws.timing import COMMAND, Psi, TimingLaw, timings_of
from rtid.plain import FloatArray, Key, silent
from tests.diagnose.records import record

LEAK: Key = ("internal_leakage_laminar", "a-b")
DELAY, SECOND = ("input_delay", COMMAND), ("spool_lag_second_order", COMMAND)
DELAY_S = 0.012


@pytest.fixture(scope="module")
def late() -> TrialState:
    """A machine whose command is late, before anything was found."""
    return TrialState(*record("input_delay", DELAY_S), silent)


def timing(state: TrialState, key: Key) -> TimingLaw:
    """The law of a name."""
    return next(t for t in timings_of(state.model, state.chunk) if t.is_at(*key))


def beside_leak(state: TrialState, key: Key, psi: Psi) -> Fit:
    """A late command, and a leak that is as good as none."""
    weights = prepare(state.model, state.chunk)
    bare = fit(state.model, state.chunk, weights, Revision())
    leak = best_by_key(bare, scored(bare))[LEAK][0]
    revision = Revision((leak,), ((timing(state, key), psi),))
    return fit(state.model, state.chunk, weights, revision, bare)


def found(key: Key, rest: Residual) -> AcceptedEffect:
    return AcceptedEffect(key, (), 1e5, 1, rest, rest)


@pytest.mark.long
def test_a_delay_takes_the_place_of_the_spools_that_had_its_turn(late: TrialState) -> None:
    """Beside a drift they had taken more: 169 less, once it was known."""
    present = beside_leak(late, SECOND, (80.0, 0.7))
    rest = late.left(present)
    late.found = [found(SECOND, rest), found(LEAK, rest)]
    now = held_again(late, present)
    assert [f.key for f in late.found] == [DELAY, LEAK]
    (column,) = now.timing_columns(0)
    ((_, (delay_s,)),) = now.revision.timings
    assert delay_s == pytest.approx(DELAY_S, abs=LIMIT_SD * now.sd_of(column))
    assert now.excess < present.excess and now.revision.has(LEAK)
    late.found.reverse()  # it was judged beside all else: nothing was found behind it
    assert held_again(late, now) is now


def of_rows(rest: Residual, rows: slice) -> Residual:
    cut = {name: getattr(rest, name)[rows] for name in ("t_s", "measured", "left", "noise")}
    return replace(rest, **cut)


@pytest.mark.long
def test_a_few_rows_do_not_refuse_what_the_first_part_shows() -> None:
    """Spools that took 64 % of a misfit beside a leak had 12 rows against them."""
    model, chunk, held_out = record("internal_leakage_laminar", 2e-12)
    state = TrialState(model, chunk, held_out, silent)
    bare = fit(model, chunk, prepare(model, chunk), Revision())
    leak = best_by_key(bare, scored(bare))[LEAK][0]
    leaking = fit(model, chunk, bare.weights, Revision((leak,)), bare, bank=False)
    without, with_it = (state.left(f) for f in (bare, leaking))
    few = slice(0, 40)
    against = of_rows(with_it, few), of_rows(without, few)  # as if the few rows spoke against it
    assert leaves_more(*against) and not is_seen_to_harm(state, bare, leaking, *against)
    assert is_seen_to_harm(state, leaking, bare, with_it, without)
    assert not is_seen_to_harm(state, bare, leaking, without, with_it)
    none = slice(0, 0)  # where the held-out part says nothing, the others do
    assert not is_seen_to_harm(state, bare, leaking, of_rows(without, none), of_rows(with_it, none))
    assert is_seen_to_harm(state, leaking, bare, of_rows(with_it, none), of_rows(without, none))
    state.held_out = state.chunk  # a record that judges itself has no other part
    assert is_seen_to_harm(state, bare, leaking, *against)


def test_parts_are_taught_in_the_order_of_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A span that is held out may stand before what teaches; what is between two parts is a gap."""
    model, chunk, held_out = record("internal_leakage_laminar", 2e-12)
    bare = fit(model, chunk, prepare(model, chunk), Revision(), bank=False)
    taught = list[FloatArray]()

    def passed(_model: object, rest: FloatArray, *_: object, **__: object) -> Fit:
        taught.append(rest)
        return bare

    monkeypatch.setattr(admission, "one_pass", passed)
    n = len(held_out)
    for teaches, judges in ((chunk, held_out), (chunk[n:], chunk[:n])):
        admission._of_part(TrialState(model, teaches, judges, silent), bare, n // 2)
    behind, before = taught
    assert len(behind) == len(chunk) and len(before) == len(chunk) - 2 * n
    for rest in taught:
        steps = np.diff(rest[:, 0])
        assert np.all(steps > 0.0)
        assert np.all(rest[1:, 1].astype(int)[steps > 2.0 * np.median(steps)] & GAP)
