"""The causes of one round against each other: which is best, and which cannot be told from it."""

from __future__ import annotations

from collections.abc import Collection, Set
from dataclasses import replace

import numpy as np

from rtid.diagnose.exact import carried_on, key_of, timing_trials, with_pump
from rtid.diagnose.fit import Fit, one_pass
from rtid.diagnose.rivals import is_told_apart
from rtid.diagnose.trials import (
    TIE,
    TIE_SHARE,
    Trial,
    TrialState,
    best_by_key,
    refined,
    scored,
    with_effect,
)
from rtid.diagnose.verdict import told_doubts
from rtid.effects.laws.lines import lines_at, stores_at
from rtid.effects.laws.openings import leaks_at, poppets_at
from rtid.effects.laws.sensors import sensor_timings
from rtid.effects.laws.timing import COMMAND
from rtid.plain import Key

REFUTED, WITHIN = 3.0, 0.05  # times the best cause's misfit; least misfit, of dof
FAR = 10.0  # times the misfit that the best cause leaves: as much is not nearly right
NEAR = 0.5  # of the best gain, that a cause must have to be nearly right where the best is no more
AT_AN_END = (lines_at, stores_at), (poppets_at, leaks_at)  # causes, and what they are there
MORE, WEIGHING = 3.0, 0.25  # times what derivatives promise; of chi2: what a fit may still gain


def trials_of(state: TrialState, present: Fit) -> list[Trial]:
    """Every possible cause with its best shape: fixed columns, and timings where they matter."""
    best = best_by_key(present, scored(present))
    timed = {key for key in best if key[1] == COMMAND}
    timed |= {key_of(timing) for timing in sensor_timings(state.model)}
    trials = []
    for key, (candidate, score) in best.items():
        if key in timed:
            continue
        trials.append(Trial(key, score.gain, with_effect(present, candidate)))
    trials = with_pump(state, present, refined(state, present, trials))
    scored_timings = {key: scores for key, scores in best.items() if key in timed}
    other = max((t.gain for t in trials if t.key not in state.negligible), default=0.0)
    return trials + timing_trials(state, present, scored_timings, other)


def alike_ones(
    state: TrialState, present: Fit, best: Trial, trials: list[Trial]
) -> tuple[Key, ...]:
    """Causes that this record does not tell from the best one: all but as good.

    One that leaves several times the misfit that the best one leaves is refuted.  Without
    pressures what disturbs the plant was taken for as large as all that was left: all of it counts,
    in units of what the best one leaves.
    """
    dof, sse = present.regression.dof, present.held.sse
    close = best.gain - TIE - TIE_SHARE * best.gain
    if state.model.has_pressures:
        refuted = sse - dof - REFUTED * max(sse - dof - best.gain, WITHIN * dof) - TIE
    else:
        refuted = sse - (REFUTED + TIE / dof) * (sse - best.gain)
    return tuple(
        t.key
        for t in trials
        if t.key != best.key and t.gain > max(close, refuted) and t.key not in state.negligible
    )


def contest(
    state: TrialState, present: Fit, best: Trial, trials: list[Trial], finished: dict[Key, Trial]
) -> tuple[Trial, tuple[Key, ...]]:
    """The cause to add, and those that this record does not tell from it.

    Where several look alike each is refitted to the end, and the best of them is asked again; among
    equals the one with the fewest parameters is taken.  finished: trials beside the same fit that
    have been refitted before; those that are now come to them.
    """
    alike = alike_ones(state, present, best, trials)
    other_times = {t.key for t in trials if _are_times(t, best) and t.gain > NEAR * best.gain}
    asked = {*alike, *(other_times - state.negligible.keys())}
    rivals = [t for t in trials if t.key in asked]
    if not rivals:
        return best, ()
    refitted = _all_finished(state, present, [best, *rivals], finished)
    best = max(refitted, key=lambda t: t.gain)
    alike = alike_ones(state, present, best, refitted)
    equals = [best, *(t for t in refitted if t.key in alike and not _is_beaten(t, refitted))]
    if best.is_timing and state.model.has_pressures:
        equals = [t for t in equals if not t.is_timing] + _as_late(state, present, refitted)
    chosen = min(equals, key=lambda t: (t.n_parameters, -t.gain))
    return chosen, tuple(t.key for t in equals if t.key != chosen.key)


def its_turn(
    state: TrialState,
    present: Fit,
    best: Trial,
    trials: list[Trial],
    finished: dict[Key, Trial],
    refuted: dict[Key, bool],
    outdone: Collection[Key] = (),
) -> tuple[Trial, tuple[Key, ...]]:
    """The contest; where a refuted cause wins that is not told from the best one, without such.

    By chi2, or by blocks where it leaves a misfit itself (`rivals`): 9 of chi2 more, of 10,700, and
    gas that comes out of oil had no turn, and no name.
    refuted: of each whether by its form alone: the right form of that law may fit as well, so that
    it stays beside the other one.  Gas that comes out of oil was told as well by air with an
    exponent at its bound, 330 better of 10,600: that was refuted, and nothing was named.
    outdone: causes that were taken before; what has ended better than one has its turn without a
    contest, which had taken that one.
    """
    if best.has_ended and outdone and best.key not in outdone:
        return best, alike_ones(state, present, best, trials)
    chosen, alike = contest(state, present, best, trials, finished)
    if chosen.key not in refuted or not (
        best.key in alike or _is_as_nearly_right(finished, chosen, best)
    ):
        return chosen, alike
    beside = tuple(key for key in (chosen.key, *alike) if refuted.get(key))
    rest = [t for t in trials if t.key not in refuted]
    chosen, alike = contest(state, present, best, rest, finished)
    return chosen, (*alike, *beside)


def _is_as_nearly_right(finished: dict[Key, Trial], refuted: Trial, best: Trial) -> bool:
    """Whether a refuted form that leaves a misfit is not told from the best cause by its blocks."""
    as_ended = finished.get(best.key)
    if refuted.fit is None or as_ended is None or as_ended.fit is None:
        return False
    leaves = refuted.fit.rho >= refuted.fit.most_rho
    return leaves and not is_told_apart(refuted.fit, as_ended.fit)


def _as_late(state: TrialState, present: Fit, trials: list[Trial]) -> list[Trial]:
    """The best of the times that were refitted, and those that are not told from it, by chi2 alone.

    All else by which they differ is the moduli beside them, and how much of the pressures' noise
    those let into the rows: that is as good as the noise that is declared.  A command that came
    5 ms late on a sweep was named a position, late by 6 ms, beside an oil of 1440 MPa for 926.
    """
    beyond = present.excess
    times = [replace(t, gain=beyond - t.fit.excess) for t in trials if t.is_timing and t.fit]
    best = max(times, key=lambda t: t.gain)
    alike = {best.key, *alike_ones(state, present, best, times)}
    return [t for t in times if t.key in alike]


def _are_times(trial: Trial, best: Trial) -> bool:
    """Whether another trial and the best one both say how late something is."""
    return trial.is_timing and best.is_timing and trial.key != best.key


def _is_beaten(trial: Trial, others: list[Trial]) -> bool:
    """True of a form that explains less than what it is at an end of it, to the end of both.

    A line without inertia is a dead volume, and a relief valve that never shuts a leak: with an
    inertia, or an opening pressure, that the record refuses they are none of those that cannot be
    told from one.
    """
    where = trial.key[1]
    plain = {key for wide, narrow in AT_AN_END if trial.key in wide(where) for key in narrow(where)}
    return any(
        other.key in plain
        and other.n_parameters < trial.n_parameters
        and trial.gain < other.gain - TIE
        for other in others
    )


def hidden_too(
    state: TrialState, best: Trial, finished: dict[Key, Trial], least_gain: float
) -> tuple[Key, ...]:
    """Causes that nothing tells from one that the maps had hidden: hardly worse, or passed over."""
    return (
        *hardly_worse(state, best, finished, least_gain),
        *passed_over(state, best, finished),
    )


def hardly_worse(
    state: TrialState, best: Trial, finished: dict[Key, Trial], least_gain: float
) -> tuple[Key, ...]:
    """Causes refitted beside the same fit that no more tells from one that the maps had hidden.

    least_gain: chi2, per number, that such a cause must take to be named; what the maps miss of a
    clean machine takes as much, and so it is no difference between two.  A turbulent leak in mixed
    valves fell 129 behind a laminar one of 2578, which was named alone.
    """
    behind = best.gain - least_gain - TIE_SHARE * best.gain
    return tuple(
        t.key
        for t in finished.values()
        if t.key != best.key
        and t.key not in state.negligible
        and t.gain > max(behind, least_gain * t.n_parameters)
        and not _is_beaten(t, list(finished.values()))
    )


def passed_over(state: TrialState, best: Trial, finished: dict[Key, Trial]) -> tuple[Key, ...]:
    """Causes that explain more than one that the maps had hidden, and were too little to matter.

    A record that cannot size them tells no lesser one from them: a hose, not stable, had taken 541
    of chi2, and a cavitation that took 297 was named alone.
    """
    return tuple(
        t.key
        for t in finished.values()
        if t.key in state.negligible and t.gain > best.gain + TIE and t.has_ended
    )


def as_nearly_right(
    state: TrialState, present: Fit, now: Fit, trials: list[Trial], finished: dict[Key, Trial]
) -> tuple[Key, ...]:
    """Causes that nothing but a misfit tells apart from the best one, which leaves it (`rivals`).

    now: the fit with the best one.  A cause beside which moduli are impossible is refuted, where
    they are possible beside that.  Before their end causes are held against the best one's gain
    before its own: of oil that boils out the derivatives saw 4595, of 6700 that it came to, where
    air came from 7285 to 9380.
    """
    if not state.model.has_pressures:  # what disturbs the plant has no blocks
        return ()
    bar = NEAR * now.wins_over(present)
    begun = NEAR * max((t.gain for t in trials if now.revision.has(t.key)), default=np.inf)
    near = [t for t in trials if t.gain > min(bar, begun) and not now.revision.has(t.key)]
    near = [t for t in near if t.key not in state.negligible]
    near = [t for t in near if t.key in finished or not _is_out_of_reach(state, present, now, t)]
    return tuple(
        t.key
        for t in _all_finished(state, present, near, finished)
        if t.fit is not None
        and t.gain > bar
        and t.fit.excess < FAR * max(now.excess, WITHIN * now.regression.dof)
        and not (_is_beaten(t, list(finished.values())) or is_told_apart(now, t.fit))
        and (told_doubts(now) or not told_doubts(t.fit))
    )


def outdone_by(
    state: TrialState, trial: Trial, finished: dict[Key, Trial], passed: Set[Key]
) -> Trial | None:
    """The cause that as it ended explains clearly more than one that leaves a misfit; None else.

    Its derivatives had promised less: beside a hysteresis of 7 % of the command, which leaves each
    direction a leak of its own, the true leak took 12,400 more of 3,300,000.
    passed: causes that were refuted, or outdone before: these take what is left when others are.
    """
    out = passed | state.negligible.keys()
    rest = [t for t in finished.values() if t.key not in out]
    best = max(rest, key=lambda t: t.gain, default=trial)
    return best if trial.key not in passed and best.gain > trial.gain + TIE else None


def _is_out_of_reach(state: TrialState, present: Fit, now: Fit, trial: Trial) -> bool:
    """True of a cause that is told apart as it stands, were it to gain as much as it ever might.

    now: the fit with the best one.  Its derivatives promise what moving the lag and shapes gains,
    three quarters of what that came to where it was far off; what weighs the rows may be a quarter.
    Six rivals of a leak, each twenty times as bad, took 28 s of 63 to be fitted to their end.
    """
    there = trial.fit or one_pass(
        state.model, state.chunk, present.weights, trial.revision, present, False, thorough=False
    )
    promise = MORE * (there.held.sse - there.estimate.sse) + WEIGHING * there.held.sse
    return is_told_apart(now, there, promise)


def _all_finished(
    state: TrialState, present: Fit, trials: list[Trial], finished: dict[Key, Trial]
) -> list[Trial]:
    """Trials refitted to the end; those that have been before, as they are in `finished`."""
    for t in trials:
        if t.key not in finished:
            finished[t.key] = _finished(state, present, t)
    return [finished[t.key] for t in trials]


def _finished(state: TrialState, present: Fit, trial: Trial) -> Trial:
    return ended(present, trial, carried_on(state, present, trial, must_win=True))


def ended(present: Fit, trial: Trial, now: Fit) -> Trial:
    """A trial as it ended: `now`, from beside the present fit."""
    gain = now.wins_over(present)
    return replace(trial, gain=gain, revision=now.revision, fit=now.light(), has_ended=True)
