"""A thinned record says what the whole one says, and finds a timing from afar."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import savgol_filter

from rtid.diagnose.exact import exact_trials
from rtid.diagnose.fit import Fit, fit, one_pass, prepare, tried
from rtid.diagnose.moving import SIZED
from rtid.diagnose.revision import Revision
from rtid.diagnose.search import Search, _vertex
from rtid.diagnose.standing import stand
from rtid.diagnose.thinned import Thinning
from rtid.effects.laws.sensors import sensor_timings
from rtid.effects.laws.timing import TIMINGS, TimingLaw
from rtid.effects.record_view import RecordView
from rtid.kernels.engine import GAP_FLAG
from rtid.model import Grid, Lag, Machine
from rtid.plain import FloatArray
from tests.diagnose.records import record


def timing(effect: str) -> TimingLaw:
    return next(t for t in TIMINGS if t.effect == effect)


def with_smaller_grids(model: Machine, chunk: FloatArray, share: float) -> Machine:
    """A machine whose grids hold but a share of the commands and pressures of a record."""
    edges = []
    for edge in model.edges:
        u = edge.direction * chunk[:, 2 + model.column(edge.command)]
        open_ = u > max(edge.safe_band_v, 0.0)
        dp = chunk[open_, 2 + model.column(edge.source)] - chunk[open_, 2 + model.column(edge.sink)]
        low, high = np.quantile(dp, [1.0 - share, share])
        of_u, of_dp = edge.grid.u_v, edge.grid.dp_pa
        of_u = of_u[of_u <= np.quantile(u[open_], share)]
        grid = Grid(of_u, of_dp[(of_dp >= low) & (of_dp <= high)])
        edges.append(replace(edge, grid=grid))
    return replace(model, edges=tuple(edges))


def without_and_with_leak(model: Machine, chunk: FloatArray) -> list[Fit]:
    """Fits without any effect, and with an external leak of chamber a."""
    weights = prepare(model, chunk)
    bank = one_pass(model, chunk, weights, Revision(), None, True).columns.candidates
    leak = next(c for c in bank if c.key == ("external_leakage_laminar", "a"))
    return [fit(model, chunk, weights, Revision(e), bank=False) for e in ((), (leak,))]


def test_means_move_by_what_flows_between_them() -> None:
    """Mean positions differ by the triangle-weighted sum of the changes, to rounding."""
    model, chunk, _ = record()
    thinning = Thinning.of(model, chunk)
    assert thinning.m == 5
    x = 2 + model.column("x")
    thin = thinning.record(model, chunk)
    assert np.diff(thin[:, x]) == pytest.approx(
        thinning.over_intervals(np.diff(chunk[:, x], append=chunk[-1, x])), abs=1e-12
    )
    assert np.diff(thin[:, 0]) == pytest.approx(5e-3)


def test_a_steady_command_stays_and_a_gap_is_kept() -> None:
    """A mean across a gap is nowhere to begin: the next one does."""
    model, chunk, _ = record()
    chunk = chunk[:1000].copy()
    u = 2 + model.column(model.edges[0].command)
    chunk[:, u] = 1.5
    chunk[502, 1] = int(chunk[502, 1]) | GAP_FLAG
    thin = Thinning.of(model, chunk).record(model, chunk)
    assert thin[:, u] == pytest.approx(1.5)
    gaps = np.flatnonzero(thin[:, 1].astype(int) & GAP_FLAG)
    assert list(gaps) == [0, 1, 100, 101]


def test_a_record_of_rare_positions_is_not_thinned() -> None:
    model, chunk, _ = record()
    chunk = chunk[:1000].copy()
    chunk[np.arange(1000) % 20 != 0, 1] = 0
    assert Thinning.of(model, chunk).m == 1


def test_a_late_command_is_closed_in_on() -> None:
    """12 ms to 3 %, in a dozen refits; a play explains clearly less."""
    model, chunk, _ = record("input_delay", 12e-3)
    fit = one_pass(model, chunk, prepare(model, chunk), Revision(), None, False, thorough=False)
    beside = Search(model, chunk).beside(fit)
    delay, play = timing("input_delay"), timing("valve_hysteresis")
    psi, gain = beside.closed_in(delay, beside.bank(delay))
    assert psi[0] == pytest.approx(12e-3, rel=0.03)
    assert gain > 1.2 * max(beside.bank(play).values())
    alone = tried(model, chunk, fit.weights, Revision((), ((delay, psi),)))
    weights = beside.weights(((delay, psi),), fit.weights, beside.search.lag_s)
    assert weights.compliance == pytest.approx(alone.compliance, rel=SIZED)  # no second pass
    assert not np.allclose(fit.weights.compliance, alone.compliance, rtol=SIZED, atol=0.0)


def test_a_lag_that_has_stood_for_the_delay_is_not_counted_beside_it() -> None:
    """A lag of 6 ms too much, as a fit without the delay finds it, with the delay whole beside it,
    was refitted to a chi2 far above that of no delay at all: what was late was named a slow spool.
    """
    model, chunk, _ = record("input_delay", 12e-3)
    weights = prepare(model, chunk)
    bent = replace(weights, lag_s=weights.lag_s + 6e-3)
    fit = one_pass(model, chunk, bent, Revision(), None, False, thorough=False)
    delay = timing("input_delay")
    late = ((delay, (12e-3,)),)
    begun = Search(model, chunk).beside(fit).weights(late, bent, weights.lag_s)
    assert begun.lag_s == weights.lag_s
    found, double = (tried(model, chunk, w, Revision((), late)) for w in (begun, bent))
    assert found.rho < 1.5 and double.rho > 5.0 * found.rho


def test_a_lag_costs_the_same_from_afar_whether_it_is_declared_or_found() -> None:
    """The declared one was applied behind the thinning: 5 ms a step.  Beside it a delay of 0.7 ms
    left 1.3 times what a spool of second order left that replaced it, and was not refitted.
    """
    model, chunk, _ = record()
    fit = one_pass(model, chunk, prepare(model, chunk), Revision(), None, False, thorough=False)
    lag = timing("spool_lag_first_order")
    search, other = (Search(replace(model, lag=Lag(at, 2e-4)), chunk) for at in (1.3e-3, 0.0))
    other.weights = replace(search.weights, lag_s=0.0)
    found = other.beside(fit).cost(((lag, (1.3e-3,)),))
    assert search.beside(fit).cost(()) == pytest.approx(found, rel=1e-6)


def test_a_bank_goes_on_until_something_has_risen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of commands that jump a delay of 20 ms was worse at 0.2 and at 2 ms than none."""
    model, chunk, _ = record()
    fit = one_pass(model, chunk, prepare(model, chunk), Revision(), None, False, thorough=False)
    beside, law = Search(model, chunk).beside(fit), timing("input_delay")
    gains = dict(zip(sorted(psi[0] for psi in law.bank), (-2.0, 3.0, 2.0, 1.0), strict=True))
    monkeypatch.setattr(beside, "before", 100.0)
    monkeypatch.setattr(beside, "gain", lambda _, psi: gains.get(psi[0], -1.0))
    assert list(beside.bank(law, 2e-4).values()) == [0.0, -1.0, -2.0, 3.0, 2.0, 1.0]
    gains[max(gains)] = gains[min(gains)] = -1001.0
    assert list(beside.bank(law).values()) == [0.0, -1001.0]


def test_a_bank_ends_where_it_falls() -> None:
    """Nothing is late: two falls, or a deep one, and stronger values are not tried."""
    model, chunk, _ = record()
    fit = one_pass(model, chunk, prepare(model, chunk), Revision(), None, False, thorough=False)
    bank = Search(model, chunk).beside(fit).bank(timing("input_delay"))
    assert 2 <= len(bank) <= 3
    assert max(bank, key=lambda x: bank[x]) == 0.0


def test_rows_are_lost_beside_the_fit_and_not_beside_what_was_tried_before() -> None:
    """60 ms of delay kept a working point on its grid for 40 of 1,492 rows more: each timing that
    was tried behind it had lost its rows, and a delay was named beside a hysteresis.
    """
    model, chunk, _ = record("valve_hysteresis", 0.3)
    model = with_smaller_grids(model, chunk, 0.98)
    fit = one_pass(model, chunk, prepare(model, chunk), Revision(), None, False, thorough=False)
    delay, play = timing("input_delay"), timing("valve_hysteresis")
    search = Search(model, chunk)
    first, later = search.beside(fit), search.beside(fit)
    later.cost(((delay, (60e-3,)),))
    for law, psi in ((play, (0.3,)), (delay, (2e-3,))):
        assert later.gain(law, psi) == first.gain(law, psi) > 0.0


@pytest.mark.parametrize("derivative", [0, 1])
def test_smooth_is_savitzky_and_golay_s(derivative: int) -> None:
    """Parabolas over the window, also at both ends."""
    model, chunk, _ = record()
    view = RecordView.without_map(model, chunk)
    p = view.pressure(0)
    half = round(0.02 / view.step_s)
    expected = savgol_filter(p, 2 * half + 1, 2, deriv=derivative, delta=view.step_s)
    scale = np.abs(expected).max()
    assert view.smooth(p, derivative) / scale == pytest.approx(expected / scale, abs=1e-9)


def test_a_timing_must_gain_what_the_lag_of_the_fit_has_gained_already() -> None:
    """Of a machine whose lag nobody has declared every timing explains the lag first."""
    model, chunk, _ = record("external_leakage_laminar", 3e-12)
    blind = replace(model, lag=Lag(0.0, 1e-3))
    present = fit(blind, chunk, prepare(blind, chunk), Revision(), bank=False)
    assert present.weights.lag_s > 0.5e-3
    beside = Search(blind, chunk).beside(present)
    late = max(beside.bank(timing("input_delay")).values())
    assert 0.0 < late < 1.2 * beside.ahead
    known = replace(present, weights=replace(present.weights, lag_s=beside.search.lag_s))
    assert Search(blind, chunk).beside(known).ahead == 0.0


@pytest.mark.long
def test_a_late_position_and_a_lag_that_nobody_has_declared_are_told_apart() -> None:
    """The lag of the fit is the sum of both, which gains more than the position alone: it was not
    refitted, and named a dead volume.  Shared by both it gains what neither does.
    """
    late_s = 2e-3
    model, chunk, held_out = record("position_sensor_delay", late_s)
    nobody = replace(model, lag=Lag(0.0, 5e-3))
    standing = stand(nobody, chunk, held_out)
    law = next(t for t in sensor_timings(nobody) if t.effect == "position_sensor_delay")
    beside = standing.state.coarse.beside(standing.fit)
    psi, gain = beside.closed_in(law, beside.bank(law))
    part, lag_s, more = beside.shared(law, psi, gain)
    lattice = [(law.at(late), lag) for late in (1.5e-3, late_s) for lag in (1e-3, 1.3e-3)]
    most = max(beside.before - beside.cost(((law, at),), lag) for at, lag in lattice)
    assert most > gain > beside.ahead
    assert more - gain > 0.8 * (most - gain)
    assert 0.0 < part[0] < psi[0] and 0.0 < lag_s < beside.fitted_s
    (trial,) = exact_trials(standing.state, standing.fit, [law])
    ((_, found),) = trial.revision.timings
    assert trial.fit is not None
    assert found[0] + trial.fit.estimate.value(trial.fit.timing_columns(0)[0]) == pytest.approx(
        late_s, rel=0.1
    )


def test_beside_an_effect_the_moduli_are_searched_for_as_well() -> None:
    """A leak per m3/s/Pa is 1e14 times a modulus' column: the moduli fell out of what was looked
    for beside it, and weights began at the highest that is possible.
    """
    model, chunk, _ = record("external_leakage_laminar", 3e-12)
    alone, present = without_and_with_leak(model, chunk)
    search = Search(model, chunk)
    beside = search.beside(present)
    assert beside.before < search.beside(alone).before
    known = beside.weights((), present.weights, present.weights.lag_s).compliance
    assert known == pytest.approx(present.weights.compliance, rel=0.1)
    beside.volumes = [{c: 1e-15 * v for c, v in volumes.items()} for volumes in beside.volumes]
    assert beside.cost(()) == pytest.approx(beside.before, rel=1e-6)


def test_a_delay_beside_a_leak_is_closed_in_on() -> None:
    """What is found first must not hide what is second."""
    late_s = 8e-3
    model, chunk, _ = record("external_leakage_laminar", 3e-12)
    chunk = chunk.copy()  # the record is kept for all tests
    for command in {edge.command for edge in model.edges}:
        column = 2 + model.column(command)
        chunk[:-8, column] = chunk[8:, column].copy()  # told before it is sent
    _, present = without_and_with_leak(model, chunk)
    beside = Search(model, chunk).beside(present)
    psi, gain = beside.closed_in(timing("input_delay"), beside.bank(timing("input_delay")))
    assert psi[0] == pytest.approx(late_s, rel=0.1)
    assert gain > 0.8 * beside.before


def test_a_spool_of_second_order_is_looked_for_in_the_place_of_a_slow_declared_lag() -> None:
    """The bank began at 800 rad/s, which gains less than a declared lag of 5 ms, and ended there:
    a spool of 157 rad/s was named a delay, or a lag of first order.
    """
    radps = 157.0
    model, chunk, _ = record("spool_lag_second_order", radps)
    slow = replace(model, lag=Lag(8e-3, 1e-3))
    present = fit(slow, chunk, prepare(slow, chunk), Revision(), bank=False)
    beside = Search(slow, chunk).beside(present)
    law = timing("spool_lag_second_order")
    bank = beside.bank(law)
    assert list(bank.values())[1] < 0.0
    psi, gain = beside.closed_in(law, bank)
    assert psi[0] == pytest.approx(radps, rel=0.1)
    assert gain > 0.0


@pytest.mark.parametrize("lost", [(True, False), (False, True), (True, True)])
def test_between_strengths_that_lose_the_record_one_goes_on(lost: tuple[bool, bool]) -> None:
    """A seat leak on a sweep ended in a traceback: the next strength was not a number."""
    low, high = (-np.inf if end else 1.0 for end in lost)
    trial = _vertex((1.0, 2.0, 4.0), [low, 2.0, high])
    assert 1.0 < trial < 4.0 and trial != 2.0
    assert (trial > 2.0) == lost[0]
