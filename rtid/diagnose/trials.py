"""Causes on trial: each one beside the model so far, and what chi2 would fall by with it.

Causes with a column of their own are scored in the one regression; timing effects are refitted
exactly where something large is left, because a bent map misleads their derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from rtid.diagnose.fit import Fit, one_pass
from rtid.diagnose.parts import AddedEffect
from rtid.diagnose.regression import LIMIT_SD, Score
from rtid.diagnose.residual import Residual, residual
from rtid.diagnose.revision import Revision
from rtid.diagnose.search import Search
from rtid.diagnose.sized import physical
from rtid.effects.column import Candidate, Cause
from rtid.effects.laws import cause_of
from rtid.effects.page import Effect
from rtid.model import Machine
from rtid.plain import FloatArray, Key, Progress

if TYPE_CHECKING:
    from rtid.diagnose.consequence import Consequence

GAIN = 16.0  # chi2 of the first effect: 60 candidates, 0.4 % for all of them together
TIE, TIE_SHARE = 12.0, 0.03  # causes within so much of the best gain are not told apart
SHARE_OF_BEST = 0.2  # of the best gain that a cause must have for its shape to be refined
ROUNDS = 8  # of refinement, each with half the step of the last
AT_END = 0.01  # of an axis' spacing: as near is at its end
SETTLED = 2e-3  # of the gain: what a round must add for another one


@dataclass(frozen=True)
class Trial:
    """A cause beside the model so far: what chi2 would fall by, and the revision with it.

    fit: an exact refit, where there is one; is_timing: it transforms a command or the supply;
    has_ended: the refit was carried on to its end.
    """

    key: Key
    gain: float
    revision: Revision
    fit: Fit | None = None
    is_timing: bool = False
    has_ended: bool = False

    @property
    def n_parameters(self) -> int:
        """Parameters that the cause brings."""
        if self.is_timing:
            return len(self.revision.timings[-1][1])
        return self.effect.n_parameters

    @property
    def effect(self) -> Candidate:
        """The candidate of a cause with a column of its own."""
        return self.revision.effects[-1]


@dataclass(frozen=True)
class AcceptedEffect:
    """An effect that was added: by how much chi2 fell, with how many parameters; residuals.

    hidden: what leaving it out does, where the maps had taken it in and the residual does not show
    it.
    """

    key: Key
    alike: tuple[Key, ...]
    gain: float
    n_parameters: int
    before: Residual
    after: Residual
    hidden: Consequence | None = None


@dataclass
class TrialState:
    """State of a diagnosis.

    judges_itself: the map is known over too little of either part, and all of the record that has
    taught it judges: what is named there is, what is not is no match.  ruled_out: timings that had
    stood in for something else.
    """

    model: Machine
    chunk: FloatArray
    held_out: FloatArray
    progress: Progress
    found: list[AcceptedEffect] = field(default_factory=list)
    negligible: dict[Key, float] = field(default_factory=dict)
    excess: float = 0.0  # chi2 without any effect beyond what the noise gives
    given: tuple[AddedEffect, ...] = ()  # effects that the model has already
    suspects: tuple[Effect, ...] = ()  # effects of the user's, scored beside the catalogue
    judges_itself: bool = False
    ruled_out: set[Key] = field(default_factory=set)
    as_taught: bool = False  # motion is judged that is like what taught the maps, and no other
    _coarse: Search | None = None

    def anew(self, progress: Progress) -> TrialState:
        """The state of a search that has not begun."""
        return replace(
            self, progress=progress, found=[], negligible={}, excess=0.0, judges_itself=False,
            ruled_out=set(), as_taught=False,
        )  # fmt: skip

    def begin(self, model: Machine) -> None:
        """Begin anew on other grids."""
        self.model, self._coarse = model, None
        self.found, self.negligible, self.ruled_out = [], {}, set()

    def left(self, fit_: Fit, leave_out: Candidate | None = None) -> Residual:
        """What a fit leaves of the part that judges; leave_out: an effect that is not counted."""
        return residual(
            fit_, self.held_out, leave_out, self.judges_itself, as_taught=self.as_taught
        )

    @property
    def coarse(self) -> Search:
        """The search on the coarse map, made when it is first needed."""
        if self._coarse is None:
            self._coarse = Search(self.model, self.chunk)
        return self._coarse


def scored(fit_: Fit) -> list[tuple[Candidate, Score]]:
    """Every candidate that is not part of the revision, beside it."""
    used = fit_.estimate.used
    return [
        (candidate, fit_.regression.score(used, fit_.first + k))
        for k, candidate in enumerate(fit_.columns.candidates)
        if candidate not in fit_.revision.effects
    ]


def best_by_key(
    present: Fit, scores: list[tuple[Candidate, Score]]
) -> dict[Key, tuple[Candidate, Score]]:
    """The candidate of each possible cause that chi2 would fall by most with."""
    best: dict[Key, tuple[Candidate, Score]] = {}
    for candidate, score in scores:
        if not candidate.is_possible(physical(present, candidate, score.value)):
            continue
        if present.revision.has(candidate.key):
            continue
        if candidate.key not in best or score.gain > best[candidate.key][1].gain:
            best[candidate.key] = candidate, score
    return best


def is_at_a_bound(now: Fit) -> bool:
    """True where a form of the last effect has ended at an end of its range; 0 is none.

    That of its page, or of what the record reaches: a place worn as wide as the whole way is
    a leak of another form.
    """
    effect = now.revision.effects[-1]
    known = [(effect.page_of(k), value) for k, value in enumerate(effect.shape)]
    if any(p and (v > 0.99 * p.high or 0.0 < v < 1.01 * p.low) for p, v in known):
        return True
    cause = cause_of(now.view, effect)
    return any(_is_at_end(cause, k, v) for k, (p, v) in enumerate(known) if p and p.over and v)


def _is_at_end(cause: Cause, k: int, value: float) -> bool:
    return min(abs(value - end) for end in cause.bounds(k)) < AT_END * cause.spacing(k)


def refined(state: TrialState, present: Fit, trials: list[Trial]) -> list[Trial]:
    """Shapes between those of the bank, where they could matter: one pass per round for all."""
    bar = max(GAIN, SHARE_OF_BEST * max((t.gain for t in trials), default=0.0))
    at = {t.key: t for t in trials}
    open_ = {t.key for t in trials if t.effect.shape and t.gain > bar}
    for k in range(ROUNDS):
        if not open_:
            break
        effects = {key: at[key].effect for key in open_}
        open_causes = {key: cause_of(present.view, effect) for key, effect in effects.items()}
        more = [
            (cause, shape)
            for key, cause in open_causes.items()
            for shape in cause.about(effects[key].shape, 0.5**k)
        ]
        finer = one_pass(
            state.model, state.chunk, present.weights, present.revision, present, False, more
        )
        best = best_by_key(finer, scored(finer))
        for key in list(open_):
            candidate, score = best.get(key, (at[key].effect, None))
            rise = score.gain - at[key].gain if score is not None else 0.0
            if score is not None and rise > 0:
                at[key] = replace(
                    at[key], gain=score.gain, revision=with_effect(present, candidate)
                )
            if rise < max(TIE, SETTLED * at[key].gain):
                open_.discard(key)
    return list(at.values())


def with_effect(present: Fit, candidate: Candidate) -> Revision:
    """The present revision with one effect more."""
    return replace(present.revision, effects=(*present.revision.effects, candidate))


def material_share(before: Residual, after: Residual) -> float:
    """What an effect takes off the held-out residual, root of the difference, of the rms flow."""
    before, after = before.at_rows_of(after), after.at_rows_of(before)
    gone = before.rms_m3s**2 - after.rms_m3s**2
    return float(np.sqrt(max(0.0, gone)) / max(before.flow_m3s, 1e-12))


def own_share(state: TrialState, now: Fit, trial: Trial, whole: Residual) -> float:
    """Size of an effect's own flow on the part that judges, as a share of the rms flow.

    whole: what the fit leaves of it.  inf for a timing.
    """
    if trial.is_timing:
        return float("inf")
    effect = now.revision.effects[-1]
    without = state.left(now, leave_out=effect)
    change = whole.left - without.left
    return float(np.sqrt(np.mean(change**2)) / max(whole.flow_m3s, 1e-12)) if change.size else 0.0


def detection_limit(score: Score, rho: float) -> float:
    """Smallest size that the record would have shown."""
    return LIMIT_SD * score.sd * float(np.sqrt(max(1.0, rho)))
