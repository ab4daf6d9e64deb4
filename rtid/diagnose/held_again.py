"""A late command that was found beside what was missing, held against its rivals without that.

What is missing shares its misfit out among the rivals: beside a drift of the gain spools of second
order took 70,000 of chi2, and a delay of 14.9 ms, which was true, fell behind by what their second
number took of the drift.  Beside all that was found later the delay was the better one, by 169.
"""

from __future__ import annotations

from dataclasses import replace

from rtid.diagnose.contest import contest
from rtid.diagnose.exact import carried_on, timing_trials
from rtid.diagnose.excuse import few_excused
from rtid.diagnose.fit import Fit, fit, with_covariances
from rtid.diagnose.standing import with_bank
from rtid.diagnose.trials import AcceptedEffect, TrialState, best_by_key, scored
from rtid.effects.laws.timing import COMMAND


def held_again(state: TrialState, present: Fit) -> Fit:
    """The fit with each timing of a command that is the best, beside all that was found later.

    `state.found` has it in the other one's place, with those that are not told from it.
    """
    for at, known in enumerate(state.found[:-1]):
        if known.key[1] == COMMAND:
            present = _contested(state, present, at, known)
    return present


def _contested(state: TrialState, present: Fit, at: int, known: AcceptedEffect) -> Fit:
    without = _without(state, present, known)
    scores = best_by_key(without, scored(without))
    timed = {key: scores[key] for key in scores if key[1] == COMMAND}
    trials = [
        t
        for t in timing_trials(state, without, timed, 0.0)
        if t.key[1] == COMMAND and t.key not in state.ruled_out
    ]
    if not trials:
        return present
    best = max(trials, key=lambda t: t.gain)
    chosen, alike = contest(state, without, best, trials, {})
    state.negligible.pop(chosen.key, None)
    is_same = chosen.key == known.key  # what was not told from it had more than what is asked now
    others = (key for key in known.alike if is_same or key[1] != COMMAND)
    alike = tuple(dict.fromkeys((*alike, *others)))
    state.found[at] = replace(known, key=chosen.key, alike=alike, n_parameters=chosen.n_parameters)
    if is_same:
        return present
    now = with_covariances(carried_on(state, without, chosen))
    return with_bank(few_excused(now), state.suspects)


def _without(state: TrialState, present: Fit, known: AcceptedEffect) -> Fit:
    """The fit with all that was found but one, every candidate beside it."""
    timings = tuple(t for t in present.revision.timings if not t[0].is_at(*known.key))
    weights = replace(present.weights, lag_s=state.model.lag.nominal_s)
    revision = replace(present.revision, timings=timings)
    record = state.model, state.chunk, weights, revision, present.light()
    return fit(*record, suspects=state.suspects)
