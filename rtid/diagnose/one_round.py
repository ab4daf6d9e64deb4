"""One round of a search: all causes on trial beside the model, and the best that deserves it.

A cause is added where it is significant, not refuted, and material: by what the held-out residual
shows, or by what the maps have taken in (`consequence`).  One that changes next to nothing is only
listed, unless it explains a part of the misfit that would be found in another guise: beside a model
that matches, what is within a form that was found would only share its size.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from rtid.diagnose.admission import (
    explains_enough,
    is_as_credible,
    is_form_of_another,
    is_noticed,
    is_of_another_form,
    is_refuted,
    is_seen_to_harm,
    is_within_a_form,
    taken_in,
)
from rtid.diagnose.consequence import BENT, HIDDEN_GAIN, Consequence
from rtid.diagnose.contest import (
    as_nearly_right,
    ended,
    hidden_too,
    its_turn,
    outdone_by,
    trials_of,
)
from rtid.diagnose.exact import carried_on
from rtid.diagnose.excuse import few_excused
from rtid.diagnose.fit import Fit, with_covariances
from rtid.diagnose.residual import Residual
from rtid.diagnose.standing import with_bank
from rtid.diagnose.trials import (
    GAIN,
    AcceptedEffect,
    Trial,
    TrialState,
    material_share,
    own_share,
)
from rtid.diagnose.verdict import MATERIAL
from rtid.plain import Key

LATER_GAIN = 25.0  # chi2 of every effect behind the first
MOST_NEGLIGIBLE = 4  # of a round, that are refitted and judged: each takes seconds
Model = tuple[Fit, Residual]  # and what it leaves of the held-out part


def add_best(state: TrialState, present: Fit, last: Residual) -> Model | None:
    """The model with the best cause that deserves it; None when there is none.

    last: what the present one leaves of the held-out part.
    """
    least = LATER_GAIN if state.found or state.given else GAIN
    trials = [
        t for t in trials_of(state, present) if t.gain > least and t.key not in state.ruled_out
    ]
    this = _Round(state, present, last, least, trials)
    turns = sorted(trials, key=lambda t: t.gain)
    while turns and this.n_negligible < MOST_NEGLIGIBLE:
        best = turns.pop()
        if best.key in state.negligible:
            continue
        if not explains_enough(state, present, best):
            return None
        added = this.tried(best, turns)
        if added is not None:
            return added
    return None


@dataclass
class _Round:
    """What a round has learned so far.

    last: what the present model leaves of the held-out part; least: chi2 that a cause must take.
    finished: trials that were fitted to their end; refuted: those that the record speaks against,
    and whether by their form alone; outdone: those in whose place another one came.
    n_negligible: trials that were judged to change next to nothing.  What is listed with one that
    it is not told from is no trial, nor what an earlier round has judged: an extra volume and three
    causes like it were four, and a leak had no turn beside them.
    """

    state: TrialState
    present: Fit
    last: Residual
    least: float
    trials: list[Trial]
    finished: dict[Key, Trial] = field(default_factory=dict)
    refuted: dict[Key, bool] = field(default_factory=dict)
    outdone: set[Key] = field(default_factory=set)
    n_negligible: int = 0

    def tried(self, best: Trial, turns: list[Trial]) -> Model | None:
        """The model with the cause whose turn it is, if that deserves it; turns: those to come."""
        state, present = self.state, self.present
        trial, alike = its_turn(
            state, present, best, self.trials, self.finished, self.refuted, self.outdone
        )
        if trial.key in self.refuted:
            return None
        now = with_covariances(carried_on(state, present, trial, must_win=True), like=present)
        if is_refuted(present, now, trial, self.least):
            self.refuted[trial.key] = not trial.is_timing and is_of_another_form(now)
            if trial.key != best.key:
                turns.append(best)  # whose turn it is still
            return None
        self.finished.setdefault(trial.key, ended(present, trial, now))
        return self._judged(best, trial, alike, now, turns)

    def _judged(
        self, best: Trial, trial: Trial, alike: tuple[Key, ...], now: Fit, turns: list[Trial]
    ) -> Model | None:
        """The model with a cause that is material, or that must be there for what else is found.

        now: the fit with it; alike: the causes that it is not told from.
        """
        state, present, last = self.state, self.present, self.last
        after, does = state.left(now), None
        own = own_share(state, now, trial, after)
        share = min(material_share(last, after), BENT * own)
        is_form = is_form_of_another(state, trial.key) or is_within_a_form(state, trial)
        is_shown = share >= MATERIAL
        is_harm = not is_shown and is_seen_to_harm(state, present, now, last, after)
        if not (is_shown or is_form or is_harm):
            does = taken_in(present, now, trial, own, last, after)
        if is_shown or does is not None:
            return self._taken(best, trial, alike, now, does, turns)
        state.negligible[trial.key] = share
        self.n_negligible += 1
        is_good = not is_harm and is_as_credible(present, now)
        is_needless = is_form and present.rho < present.most_rho
        if is_good and is_noticed(present, self.finished[trial.key]) and not is_needless:
            return self._kept_aside(now, trial, alike, own)
        return None

    def _taken(
        self,
        best: Trial,
        trial: Trial,
        alike: tuple[Key, ...],
        now: Fit,
        does: Consequence | None,
        turns: list[Trial],
    ) -> Model | None:
        """The model with a material cause; None where another one ended better, whose turn it is.

        does: what the maps had taken in of it.
        """
        state, present = self.state, self.present
        present.unread()  # what is read beside the next one is as large
        kept, after = _with_bank(state, now)
        as_ended, is_left = self.finished[trial.key], kept.rho >= kept.most_rho
        if does:
            alike += hidden_too(state, as_ended, self.finished, HIDDEN_GAIN)
        if is_left:
            alike += as_nearly_right(state, present, now, self.trials, self.finished)
            passed_over = {*self.refuted, *self.outdone}
            if better := outdone_by(state, as_ended, self.finished, passed_over):
                self.outdone.add(trial.key)
                self.trials = [self.finished.get(t.key, t) for t in self.trials]
                turns += [best, better]
                return None
        what = trial.key, tuple(dict.fromkeys(alike)), trial.gain, trial.n_parameters
        state.found.append(AcceptedEffect(*what, self.last, after, does))
        return kept, after

    def _kept_aside(self, now: Fit, trial: Trial, alike: tuple[Key, ...], flow: float) -> Model:
        """The model with what is only listed, unless it is shown beside all that the blocks hold.

        flow: its own, of the rms flow.
        """
        state, last = self.state, self.last
        kept, after = _with_bank(state, now)
        if _is_shown_now(trial.key, min(material_share(last, after), BENT * flow), state):
            what = trial.key, alike, trial.gain, trial.n_parameters
            state.found.append(AcceptedEffect(*what, last, after, None))
        else:
            state.negligible |= dict.fromkeys(alike, state.negligible[trial.key])
        return kept, after


def _with_bank(state: TrialState, now: Fit) -> Model:
    """A fit with every candidate beside it, and what it leaves of the held-out part."""
    kept = with_bank(few_excused(now), state.suspects)
    return kept, state.left(kept)


def _is_shown_now(key: Key, share: float, state: TrialState) -> bool:
    """True where the residual shows it once the blocks that missed it are excused no longer.

    share: that it takes off the held-out residual.  On a sweep a leak of 5 % of the flow was set
    aside, and a relief valve was named for what its form misses.
    """
    is_shown = share >= MATERIAL and not is_form_of_another(state, key)
    if is_shown:
        del state.negligible[key]
    return is_shown
