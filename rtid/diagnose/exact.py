"""Exact refits of what transforms a command or the supply: a bent map misleads derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from rtid.diagnose.fit import Fit, fit, one_pass, tried, with_rows_of
from rtid.diagnose.lag_interval import UNEVEN, shared
from rtid.diagnose.moving import LAG_REACH, NOISE
from rtid.diagnose.regression import Score
from rtid.diagnose.revision import is_slow_spool
from rtid.diagnose.search import Beside
from rtid.diagnose.trials import GAIN, Trial, TrialState, scored
from rtid.effects.column import Candidate
from rtid.effects.law import Shape
from rtid.effects.laws.pump import PUMP, usual_demand
from rtid.effects.laws.sensors import sensor_timings
from rtid.effects.laws.timing import DEAD_BAND, Psi, TimingLaw, delayed, played, timings_of
from rtid.effects.record_view import RecordView
from rtid.estimator.orifice import root
from rtid.estimator.track import pressure_drop
from rtid.plain import FloatArray, Key

LARGE = 1.5  # rho above which timing effects are refitted whatever their score
SHARES = 0.25, 0.5  # of what a delay and the lag come to, at which the lag is tried
HALVINGS = 6  # of a step along the valley of a lag and a play
CLOSE = 0.9  # timings whose coarse gain is this share of the best are refitted finely
# where a valve opens: shares of its largest flow gain, bins of the command, least sqrt(dp)
RISES, BINS, LEAST_ROOT = (0.15, 0.4), 40, 300.0
NO_HINTS: Mapping[Key, float] = MappingProxyType({})
# of the best gain from afar, from which a limit and the lag that it is in are found by a simplex of
# this size, in this many refits: the derivative of one says next to nothing beside maps it has bent
LIKELY, NARROW, POLISHING = 0.5, 0.15, 24
OF_SIMPLEX = (
    6  # refits, times the square of the parameters: with 24 for three it stayed at 36 of 40
)
PROMISING = 0.3  # share of the best gain that a timing must reach from afar to be refitted
# pumps to begin with: droops as shares of that seen, quantiles of the demand, stiffness in Pa/m3.
# The cost has a valley for each lag: of a supply that took 0.4 s for a droop 1.6 times the one seen
# a slower, weaker pump was found, that left rho 18 for 4.4
DROOPS, PUMP_LIMITS = (0.1, 0.7, 1.5), (0.8, 0.93, 0.98)
STIFFNESSES = (3e8, 1e9, 3e9, 1e10, 1e11, 1e12)
# of one that never reaches its limit: the first order sees a third of a droop, and one that is a
# fifth off, or half as fast, explains less than none
WHOLE_DROOPS, SETTLING_S = (
    (0.35, 0.6, 1.0, 1.4, 1.9, 2.5, 3.3),
    (0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6),
)


def with_pump(state: TrialState, present: Fit, trials: list[Trial]) -> list[Trial]:
    """A supply that sags is refitted exactly: its first-order forms only say whether it may.

    They may point to a supply that rises: on a fine grid the maps have followed most of a sag.
    """
    key = PUMP.effect, present.view.supply_name
    first = [t for t in trials if t.key == key]
    rest = [t for t in trials if t.key != key]
    bar = PROMISING * max((t.gain for t in rest), default=0.0)
    if not any(t.gain >= bar for t in first) and not _sags(state, present, key, bar):
        return rest
    beside = state.coarse.beside(present)
    pumped = [_with_pump(state, present, beside.polished(PUMP, p)) for p in _pumps(present)]
    now = min(pumped, key=lambda fitted: fitted.excess)
    gain = present.excess - now.excess
    return [*rest, Trial(key, gain, now.revision, now, True)]


def _with_pump(state: TrialState, present: Fit, psi: Psi) -> Fit:
    revision = replace(present.revision, timings=(*present.revision.timings, (PUMP, psi)))
    return fit(state.model, state.chunk, present.weights, revision, bank=False).light()


def _sags(state: TrialState, present: Fit, key: Key, bar: float) -> bool:
    """True where the supply is declared constant, and a pump explains more than a bar from afar.

    A sag that is not small bends the maps: its first-order forms say little of it.  key: of the
    pump, which the fit may have already.
    """
    is_open = key[1] and not present.revision.has(key)
    if not is_open or present.rho < LARGE or np.ptp(present.view.signal(key[1])) > 0.0:
        return False
    beside = state.coarse.beside(present)
    return max(beside.gain(PUMP, psi) for bank in _pumps(present) for psi in bank) >= bar


def _pumps(present: Fit) -> tuple[list[Psi], ...]:
    """Pumps to begin with, about the droop that is seen: limited within what is drawn, or never.

    And where the first order sees one that only gives way at its limit, about that one.
    """
    drawn, seen = usual_demand(present.view), _seen_pumps(present)
    r = float(max([*(value for _, value in seen["resistance"]), PUMP.low[0]]))
    limits, most = np.quantile(drawn[drawn > 0], PUMP_LIMITS), 2.0 * float(drawn.max())
    limited: list[Psi] = [
        (r * part, float(q), s) for part in DROOPS for q in limits for s in STIFFNESSES
    ]
    whole: list[Psi] = [
        (r * part, most, r * part / tau) for part in WHOLE_DROOPS for tau in SETTLING_S
    ]
    at_limit: list[Psi] = [
        (s * tau, *shape, s) for shape, s in seen["stiffness"] if s > 0.0 for tau in SETTLING_S
    ]
    return (limited, whole, at_limit) if at_limit else (limited, whole)


def _seen_pumps(present: Fit) -> dict[str, list[tuple[Shape, float]]]:
    """Shapes and sizes of both first-order forms of a pump, by the parameter that is a size."""
    seen: dict[str, list[tuple[Shape, float]]] = {"resistance": [], "stiffness": []}
    for candidate, score in scored(present):
        if candidate.effect == PUMP.effect:
            seen[candidate.parameter].append((candidate.shape, score.value))
    return seen


def timing_trials(
    state: TrialState, present: Fit, scores: dict[Key, tuple[Candidate, Score]], other: float
) -> list[Trial]:
    """Exact refits with one timing more, of those that may matter; scores: of the first order.

    Without pressures a disturbance as large as what is left hides how much that is: then a timing
    may matter whose first order is clear, though it may point the wrong way.  Maps of a state that
    a delay has bent hide the first order as well: there the first timing is looked for by refits.
    A delay always is: where commands jump, its first order sees no further than a sample, and one
    of 20 ms was a lag of 9.6 ms that matched.
    """
    timings = (*timings_of(state.model, state.chunk), *sensor_timings(state.model))
    open_ = [t for t in timings if not present.revision.has(key_of(t))]
    if not state.model.has_pressures and (state.model.measured or present.revision.timings):
        stirred = {c.key for c, score in scored(present) if score.gain > GAIN}
        open_ = [t for t in open_ if key_of(t) in stirred]
    elif state.model.has_pressures and present.rho < LARGE:
        clear = {key for key, (_, score) in scores.items() if score.gain > GAIN}
        open_ = [t for t in open_ if key_of(t) in clear or t.apply is delayed]
    if not open_ or not present.view.has_pressures:
        return []
    hints = {key_of(t): _strength(t, *scores[key_of(t)]) for t in open_ if key_of(t) in scores}
    return exact_trials(state, present, open_, other, hints)


def _begun(present: Fit, timings: list[TimingLaw]) -> Iterator[TimingLaw]:
    """The timings; one behind the opening curve begins at the dead band that the maps show.

    A limit is within the lag of the spools, where they are declared to have one.
    """
    lag, lag_s = present.declared.lag, present.weights.lag_s
    has_lag = lag.nominal_s + lag.tolerance_s > 0.0
    for timing in timings:
        if timing.is_limit and timing.is_within_lag == has_lag:
            yield timing.beside_lag(lag_s) if has_lag else timing
        elif timing.is_limit:
            continue
        elif DEAD_BAND not in timing.parameters:
            yield timing
        elif (dead_v := opens_at(present.view)) > 0.0:
            yield replace(timing, bank=tuple((*psi[:-1], dead_v) for psi in timing.bank))


def opens_at(view: RecordView) -> float:
    """The command at which the valves open by the fitted maps, V: their middle; 0 for none.

    From there the flow gain Q / s(dp) rises straight through two shares of its largest.
    """
    at = []
    for i, edge in enumerate(view.model.edges):
        w, s = view.opening(i), root(pressure_drop(view.model, edge, view.chunk[:, 2:]))
        s = 0.5 * (s[1:] + s[:-1])
        here = view.inside & (w > 0.0) & (np.abs(s) > LEAST_ROOT)
        if np.count_nonzero(here) > BINS**2:
            at.append(_foot(w[here], view.flow(i)[here] / s[here]))
    return max(0.0, float(np.median(at))) if at else 0.0


def _foot(w: FloatArray, gain: FloatArray) -> float:
    """Where the gain over w, both (n,), begins to rise."""
    border = np.linspace(0.0, float(w.max()), BINS + 1)
    place = np.clip(np.searchsorted(border, w, side="right") - 1, 0, BINS - 1)
    full = [k for k in range(BINS) if np.count_nonzero(place == k) >= BINS]
    middle = np.array([0.5 * (border[k] + border[k + 1]) for k in full])
    usual = np.maximum.accumulate([np.median(gain[place == k]) for k in full])
    if len(full) < 2 or usual[-1] <= 0.0:
        return 0.0
    low, high = np.interp(np.array(RISES) * usual[-1], usual, middle)
    return float(low - (high - low) * RISES[0] / (RISES[1] - RISES[0]))


def _strength(timing: TimingLaw, candidate: Candidate, score: Score) -> float:
    """How strong the first order takes a timing to be: so many times that of its column."""
    return score.value * (timing.strength(candidate.shape) if candidate.shape else 1.0)


def key_of(timing: TimingLaw) -> Key:
    """Name and place of a timing, as of a candidate."""
    return timing.effect, timing.where


def exact_trials(
    state: TrialState,
    present: Fit,
    timings: list[TimingLaw],
    other: float = 0.0,
    hints: Mapping[Key, float] = NO_HINTS,
    anywhere: bool = False,
) -> list[Trial]:
    """Refits with one of these timings more, the best of each name.

    other: the best gain of any other cause; what cannot come close to it is left out.  hints:
    strengths by name to try as well, where they are below those of the bank.  anywhere: those too
    that end at nothing or at a bound, and so are no causes.
    """
    timings, coarse = [*_begun(present, timings)], state.coarse.beside(present)
    present.unfactored().at_rest()
    gains = _from_afar(coarse, timings, other, hints, anywhere)
    # a gain from afar is that of the thinned record: 154,000 for 315,000 of chi2
    least = max(
        [0.0 if anywhere else GAIN, PROMISING * other, *(CLOSE * gain for gain, *_ in gains)]
    )
    trials: dict[Key, Trial] = {}
    for gain, timing, psi, lag_s in gains:
        if gain < least:
            continue
        revision = replace(present.revision, timings=(*present.revision.timings, (timing, psi)))
        weights = coarse.weights(((timing, psi),), present.weights, lag_s)
        now = tried(state.model, state.chunk, weights, revision)
        if not (anywhere or is_inside(now)):
            continue
        exact = present.excess - (now.estimate.sse - now.regression.dof)
        key = key_of(timing)
        if key not in trials or exact > trials[key].gain:
            trials[key] = Trial(key, exact, now.revision, now, True)
    return list(trials.values())


def carried_on(state: TrialState, present: Fit, trial: Trial, must_win: bool = False) -> Fit:
    """The fit with a trial's revision, to the end; must_win: or until it is given up."""
    revision, weights, start = trial.revision, present.weights, present
    if trial.fit is not None:
        weights, start = trial.fit.weights, with_rows_of(present, trial.fit)
    record = state.model, state.chunk, weights, revision, start
    if trial.has_ended and not trial.is_timing:  # a lag and a delay go on to trade off
        return one_pass(*record, bank=False, thorough=False)
    ended = fit(*record, bank=False, other=present if must_win else None)
    return _split_anew(state, ended) if trial.is_timing else ended


def _split_anew(state: TrialState, now: Fit) -> Fit:
    """What is late as a lag is and the lag of the spools, from other shares of what both come to.

    A lag far below a sample is a part of one of delay, and there the cost is level: a fit stood
    still at 4.85 ms of delay and 0.11 of lag, 3.80 and 1.2 being true, at 60 of chi2 above it.  By
    the parts of samples the cost is uneven, by 20.  A slow spool of one pole is not the declared
    one behind another: 10.2 ms were 5.1 and 5.0, which left 15 times the noise.  And a play whose
    derivative is that of each reversal walks no valley: 51 +- 0.1 mA were told of 41, and 2.9 ms of
    4.9, where the truth left 47 less.
    """
    last = len(now.revision.timings) - 1
    timing, _ = now.revision.timings[last]
    if now.lag_tolerance_s == 0.0:
        return now
    best = _along_valley(state, now) if timing.apply is played else now
    for lag_s in _lags_of(state, now):
        trial = shared(now.light(), last, lag_s)
        if trial.excess < best.excess - UNEVEN * now.regression.dof:
            best = trial
    if best is now:
        return now
    return fit(state.model, state.chunk, best.weights, best.revision, best, bank=False)


def _along_valley(state: TrialState, now: Fit) -> Fit:
    """The least of a lag and a play that make up for one another, by steps that are halved."""
    lag, best, last = state.model.lag, now, len(now.revision.timings) - 1
    most_s = lag.nominal_s + LAG_REACH * lag.tolerance_s
    for k in range(1, HALVINGS + 1):
        for way in (1.0, -1.0):
            lag_s = best.weights.lag_s + way * 0.5**k * lag.tolerance_s
            if 0.0 <= lag_s <= most_s:
                trial = shared(best.light(), last, lag_s)
                if trial.excess < best.excess - NOISE:
                    best = trial
                    break
    return best


def _lags_of(state: TrialState, now: Fit) -> list[float]:
    """Lags of the spools to try, s, beside the last timing: a delay, or spools that are slow."""
    (last, psi), nominal_s = now.revision.timings[-1], state.model.lag.nominal_s
    if is_slow_spool(last):
        return [0.0]
    lags = [share * (psi[0] + now.weights.lag_s) for share in SHARES if last.apply is delayed]
    return [s for s in lags if abs(s - nominal_s) <= LAG_REACH * now.lag_tolerance_s]


def _from_afar(
    coarse: Beside,
    timings: list[TimingLaw],
    other: float,
    hints: Mapping[Key, float],
    anywhere: bool,
) -> list[tuple[float, TimingLaw, Psi, float]]:
    """Gain, parameters and the lag beside every timing that is promising from afar; one a name.

    anywhere: of all.  The gain is over the fit as it is, with the lag that it has found.
    A lag may be before or behind the opening curve, and spools of second order may be each
    direction's own: from so far that cannot be told.  Where the lag has gone ahead, the sum that it
    stands for is known far better than the steps of a bank: each is closed in on before it is held
    against the lag.  A position that came 4.2 ms late lost by what its bank missed of 7.0.
    """
    beside = [timing for timing in timings if not timing.replaces_lag]
    banks = {timing: coarse.bank(timing, hints.get(key_of(timing), 0.0)) for timing in beside}
    ahead, instead = 0.0 if anywhere else coarse.ahead, _instead_of_the_lag(coarse, timings)
    starts = {t: _closed_in(coarse, t, bank) for t, bank in banks.items() if ahead or t.is_limit}
    seen = {timing: _best_of(coarse, timing, bank) - ahead for timing, bank in banks.items()}
    for timing, start in starts.items():
        seen[timing] = max(seen[timing], coarse.shared(timing, *start)[2] - ahead)
    seen |= {timing: gain - ahead for timing, (_, gain) in instead.items()}
    bar = PROMISING * max([other, *seen.values()])
    best: dict[tuple[Key, bool, bool], tuple[float, TimingLaw, Psi, float]] = {}
    for timing in seen:
        if not anywhere and (seen[timing] < bar or seen[timing] <= 0.0):
            continue
        start = instead.get(timing) or starts.get(timing) or coarse.closed_in(timing, banks[timing])
        bends = timing.is_limit or DEAD_BAND in timing.parameters
        if bends and seen[timing] > LIKELY * max(seen.values()):
            most = max(POLISHING, OF_SIMPLEX * len(start[0]) ** 2)
            psi = coarse.polished(timing, [start[0]], NARROW, most)
            start = psi, coarse.gain(timing, psi)
        psi, lag_s, gain = coarse.shared(timing, *start)
        gain -= ahead
        own = timing.replaces_lag and timing.own_spools
        form = key_of(timing), DEAD_BAND in timing.parameters, own
        if form not in best or gain > best[form][0]:
            best[form] = gain, timing, psi, lag_s
    return list(best.values())


def _instead_of_the_lag(
    coarse: Beside, timings: list[TimingLaw]
) -> dict[TimingLaw, tuple[Psi, float]]:
    """Where timings that replace the spools' lag do best from afar, and their gains.

    Their bank is three times apart, the lag of the fit is far nearer to what both stand for: they
    are closed in on before anything is held against it.  Spools of their own begin where others do.
    """
    found: dict[TimingLaw, tuple[Psi, float]] = {}
    for timing in (timing for timing in timings if timing.replaces_lag):
        known = [psi for other, (psi, _) in found.items() if other.effect == timing.effect]
        if known:
            psi = (*known[0], *timing.bank[0][len(known[0]) :])  # a dead band beside them
            found[timing] = psi, coarse.gain(timing, psi)
        else:
            start = _closed_in(coarse, timing, coarse.bank(timing))
            found[timing] = start if timing.is_limit else coarse.damped(timing, *start)
    return found


def _closed_in(coarse: Beside, timing: TimingLaw, bank: Mapping[float, float]) -> tuple[Psi, float]:
    """Where a bank leads; a limit is closed in on where a little of it explains anything at all."""
    if timing.is_limit and max(bank.values()) <= 0.0:
        strength = max(list(bank)[1:], key=lambda x: bank[x])
        return timing.at(strength), bank[strength]
    return coarse.closed_in(timing, dict(bank))


def _best_of(coarse: Beside, timing: TimingLaw, bank: Mapping[float, float]) -> float:
    """The largest gain of a bank of strengths from 0 on, alone or with the lag of the fit."""
    strength = max(list(bank)[1:], key=lambda x: bank[x])
    return coarse.shared(timing, timing.at(strength), bank[strength])[2]


def is_inside(now: Fit) -> bool:
    """True where the timing that was added last did not end at a bound, nor at nothing."""
    timing, psi = now.revision.timings[-1]
    sd = now.estimate.sd(now.timing_columns(len(now.revision.timings) - 1)[0])
    return timing.is_free(psi, 0) and psi[0] > 3.0 * sd
