"""Which physical effect is missing: score all, add the best, look back, and say what is not known.

Each round scores every candidate beside the model so far; timing effects are refitted exactly where
something large is left, because a bent map misleads their derivatives.  The best is added if it is
significant, possible and material; when nothing more is, the verdict follows from what is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from rtid.diagnose.candidates import Candidate, causes
from rtid.diagnose.clean import as_measured, usable
from rtid.diagnose.fit import Fit, Revision, fit, one_pass, prepare
from rtid.diagnose.parts import Part, recall
from rtid.diagnose.regression import LIMIT_SD, Score
from rtid.diagnose.residual import Residual, residual
from rtid.diagnose.search import Search
from rtid.diagnose.timing import TIMINGS, Psi, Timing
from rtid.model import FloatArray, Model

GAIN = 16.0  # chi2 of the first effect: 60 candidates, 0.4 % for all of them together
LATER_GAIN = 25.0  # of every further one
MATERIAL = 0.003  # of the rms flow: what an effect must change of the held-out residual
LARGE = 1.5  # rho above which timing effects are refitted whatever their score
TIE, TIE_SHARE = 12.0, 0.03  # causes within so much of the best gain are not told apart
MOST = 6  # effects that are added at most
WORSE = 1.02  # held-out residual, as a share, that an immaterial effect may not raise
BENT = 3.0  # times its own flow that an effect may gain: it also bends the maps when it is missing
LEAST_ROWS = 50  # filtered rows that a held-out part must have, or the other part judges
MOST_NEGLIGIBLE = 4  # that are looked at
NOTICED = 0.01  # of the degrees of freedom: chi2 from which an immaterial effect stays in the model
SHARE = 0.4  # of the misfit left that a cause must explain, once most of the first is explained,
LEAST_SHARE = 0.1  # ... and before
CLOSE = 0.9  # timings whose coarse gain is this share of the best are refitted finely
PROMISING = 0.3  # share of the best gain that a timing's bank must reach to be closed in on

MATCH_RHO = 1.10  # largest rho of a model that matches
MATCHES, MISSING, AMBIGUOUS = "matches", "missing", "ambiguous"
UNKNOWN, INSUFFICIENT = "unknown", "insufficient_data"

Key = tuple[str, str]


@dataclass(frozen=True)
class Trial:
    """A cause beside the model so far: what chi2 would fall by, and the revision with it."""

    key: Key
    gain: float
    revision: Revision
    column: int | None = None  # of the fit that scored it
    fit: Fit | None = None


@dataclass(frozen=True)
class Found:
    """An effect that was added: the fit with it, the residuals before and after."""

    key: Key
    alike: tuple[Key, ...]
    gain: float
    before: Residual
    after: Residual


@dataclass
class State:
    """State of a diagnosis."""

    model: Model
    chunk: FloatArray
    held_out: FloatArray
    progress: Callable[[str, float], None]
    found: list[Found] = field(default_factory=list)
    negligible: dict[Key, float] = field(default_factory=dict)
    excess: float = 0.0  # chi2 without any effect beyond what the noise gives
    given: tuple[Part, ...] = ()  # effects that the model has already
    _coarse: Search | None = None

    @property
    def coarse(self) -> Search:
        """The search on the coarse map, made when it is first needed."""
        if self._coarse is None:
            self._coarse = Search(self.model, self.chunk)
        return self._coarse


@dataclass(frozen=True)
class Result:
    """The first and the last fit, what was given before, added on the way, and left."""

    first: Fit
    last: Fit
    found: tuple[Found, ...]
    negligible: dict[Key, float]
    scores: list[tuple[Candidate, Score]]
    before: Residual
    after: Residual
    verdict: str
    given: tuple[Part, ...] = ()
    match_rho: float = MATCH_RHO
    held_out_judged: bool = True  # False: too little of it is known, and the record itself judged


def _silent(_what: str, _share: float) -> None:
    pass


def search(
    model: Model,
    chunk: FloatArray,
    held_out: FloatArray,
    progress: Callable[[str, float], None] = _silent,
    parts: tuple[Part, ...] = (),
) -> Result:
    """Diagnose a record; chunk and held_out (n, 2 + signals) as from `to_chunk`.

    parts: effects that the model has already.  Raises PartError where the record has none of them.
    Where the map is known over next to nothing of the held-out part, the record itself judges.
    """
    state, first = begin(model, chunk, held_out, progress, parts)
    present = first
    judged = len(residual(first, state.held_out).t_s) >= LEAST_ROWS
    if not judged:
        state.held_out = state.chunk
    before = last = residual(first, state.held_out)
    bare = _bare(state, first)
    state.excess = bare.estimate.sse - bare.regression.dof
    for k in range(MOST):
        progress("scoring", 0.1 + 0.8 * k / MOST)
        added = _add_best(state, present, last)
        if added is None:
            break
        present, last = added
    present, last = _look_back(state, present, last)
    scores = scored(present)
    verdict = _verdict(state, present, last)
    found, negligible = tuple(state.found), state.negligible
    return Result(
        first, present, found, negligible, scores, before, last, verdict, parts,
        held_out_judged=judged,
    )  # fmt: skip


def begin(
    model: Model,
    chunk: FloatArray,
    held_out: FloatArray,
    progress: Callable[[str, float], None],
    parts: tuple[Part, ...],
) -> tuple[State, Fit]:
    """The usable part of a record, and the model with its parts fitted to it."""
    model = as_measured(model, chunk)
    chunk, held_out = usable(model, chunk), usable(model, held_out)
    progress("fitting", 0.0)
    weights = prepare(model, chunk)
    first = fit(model, chunk, weights, recall(model, chunk, weights, parts))
    return State(model, chunk, held_out, progress, given=parts), first


def _bare(state: State, first: Fit) -> Fit:
    """The fit without any effect."""
    if not state.given:
        return first
    weights = replace(first.weights, lag_s=state.model.lag.nominal_s)
    return fit(state.model, state.chunk, weights, Revision(), bank=False)


def scored(fit_: Fit) -> list[tuple[Candidate, Score]]:
    """Every candidate that is not part of the revision, beside it."""
    used = fit_.estimate.used
    return [
        (candidate, fit_.regression.score(used, fit_.first + k))
        for k, candidate in enumerate(fit_.columns.candidates)
        if candidate not in fit_.revision.effects
    ]


def _add_best(state: State, present: Fit, last: Residual) -> tuple[Fit, Residual] | None:
    """Add the best cause that is significant and material; None when there is none.

    One that is significant but changes next to nothing is only listed, unless it explains a part of
    the misfit that would be found in another guise.
    """
    least = LATER_GAIN if state.found or state.given else GAIN
    trials = [t for t in _trials(state, present) if t.gain > least]
    for trial in sorted(trials, key=lambda t: -t.gain):
        if trial.key in state.negligible or len(state.negligible) == MOST_NEGLIGIBLE:
            continue
        if not _explains(state, present, trial):
            return None
        now = trial.fit or fit(
            state.model, state.chunk, present.weights, trial.revision, present.map, bank=False
        )
        now = one_pass(state.model, state.chunk, now.weights, now.revision, now.map, True)
        after = residual(now, state.held_out)
        own = BENT * own_share(now, trial, state.held_out)
        share = min(material_share(last, after), own)
        if share < MATERIAL:
            state.negligible[trial.key] = share
            if not _is_noticed(present, trial) or after.rms_m3s > WORSE * last.rms_m3s:
                continue
            for other in alike_ones(state, trial, trials):
                state.negligible[other] = share
        else:
            alike = alike_ones(state, trial, trials)
            state.found.append(Found(trial.key, alike, trial.gain, last, after))
        return now, after
    return None


def _is_noticed(present: Fit, trial: Trial) -> bool:
    """True for an immaterial cause that explains a fair part of the misfit all the same."""
    dof = present.regression.dof
    return trial.gain > max(NOTICED * dof, LEAST_SHARE * (present.estimate.sse - dof))


def _explains(state: State, present: Fit, trial: Trial) -> bool:
    """False where a cause is a small part of what is left behind an effect of the wrong form.

    Once most of the first misfit is explained, the rest of a form that is nearly right would be
    named as effects of their own.
    """
    left = present.estimate.sse - present.regression.dof
    excess = state.excess
    if present.rho < MATCH_RHO or excess <= 0:
        return True
    return trial.gain > (SHARE if left < (1 - NAMED) * excess else LEAST_SHARE) * left


def _with(state: State, present: Fit, trial: Trial) -> Fit:
    """The fit with a trial's revision, every candidate beside it."""
    start, weights = (
        (trial.fit.map, trial.fit.weights) if trial.fit else (present.map, present.weights)
    )
    return fit(state.model, state.chunk, weights, trial.revision, start)


def material_share(before: Residual, after: Residual) -> float:
    """What an effect takes off the held-out residual, root of the difference, of the rms flow."""
    gone = before.rms_m3s**2 - after.rms_m3s**2
    return float(np.sqrt(max(0.0, gone)) / max(before.flow_m3s, 1e-12))


def own_share(now: Fit, trial: Trial, held_out: FloatArray) -> float:
    """Size of an effect's own flow on the held-out part, of the rms flow."""
    if trial.column is None:
        return float("inf")
    effect = now.revision.effects[-1]
    whole = residual(now, held_out)
    without = residual(now, held_out, leave_out=effect)
    change = whole.left - without.left
    return float(np.sqrt(np.mean(change**2)) / max(whole.flow_m3s, 1e-12)) if change.size else 0.0


def _trials(state: State, present: Fit) -> list[Trial]:
    """Every possible cause with its best shape: fixed columns, and timings where they matter."""
    best = best_by_key(present, scored(present))
    trials = []
    for key, (candidate, score) in best.items():
        if key[1] == "command":
            continue
        revision = replace(present.revision, effects=(*present.revision.effects, candidate))
        trials.append(Trial(key, score.gain, revision, score.column))
    trials = refined(state, present, trials)
    scores = {key: s.gain for key, (_, s) in best.items() if key[1] == "command"}
    other = max((t.gain for t in trials if t.key not in state.negligible), default=0.0)
    return trials + _timing_trials(state, present, scores, other)


def best_by_key(
    present: Fit, scores: list[tuple[Candidate, Score]]
) -> dict[Key, tuple[Candidate, Score]]:
    """The candidate of each possible cause that chi2 would fall by most with."""
    best: dict[Key, tuple[Candidate, Score]] = {}
    for candidate, score in scores:
        if not candidate.is_possible(physical(present, candidate, score.value)):
            continue
        if present.revision.has(candidate.key) and candidate.where != "":
            continue
        if candidate.key not in best or score.gain > best[candidate.key][1].gain:
            best[candidate.key] = candidate, score
    return best


def physical(fit_: Fit, candidate: Candidate, value: float) -> float:
    """A coefficient as the effect's parameter.

    A dead volume counts by the fitted modulus, a drift over the length of the record.
    """
    if candidate.effect == "valve_gain_drift":
        return value * float(fit_.view.t_s[-1] - fit_.view.t_s[0])
    if candidate.effect != "extra_dead_volume":
        return value
    names = [c.name for c in fit_.model.chambers]
    at = [names.index(candidate.where)] if candidate.where in names else list(range(len(names)))
    return float(value * np.mean(fit_.weights.compliance[at] / fit_.compliance[at]))


def refined(state: State, present: Fit, trials: list[Trial]) -> list[Trial]:
    """Shapes between those of the bank, where they could matter, in one more pass."""
    if not trials:
        return trials
    bar = max(GAIN, 0.2 * max(t.gain for t in trials))
    shaped = {
        t.key: t.revision.effects[-1]
        for t in trials
        if t.revision.effects[-1].shape is not None and t.gain > bar
    }
    more = [
        (cause, shape)
        for cause in causes(present.view)
        if cause.candidate.key in shaped and cause.makes(shaped[cause.candidate.key])
        for shape in cause.finer(shaped[cause.candidate.key].shape or 0.0)
    ]
    if not more:
        return trials
    finer = one_pass(
        state.model, state.chunk, present.weights, present.revision, present.map, False, more
    )
    best = best_by_key(finer, scored(finer))
    found = []
    for trial in trials:
        candidate, score = best.get(trial.key, (None, None))
        if candidate is not None and score is not None and score.gain > trial.gain:
            effects = (*present.revision.effects, candidate)
            revision = replace(present.revision, effects=effects)
            found.append(Trial(trial.key, score.gain, revision, trial.column))
        else:
            found.append(trial)
    return found


def _timing_trials(
    state: State, present: Fit, scores: dict[Key, float], other: float
) -> list[Trial]:
    """Exact refits with one timing more, of those that may matter."""
    open_ = [t for t in TIMINGS if not present.revision.has((t.effect, "command"))]
    if present.rho < LARGE:
        open_ = [t for t in open_ if scores.get((t.effect, "command"), 0.0) > GAIN]
    if not open_ or not present.view.has_pressures:
        return []
    return exact_trials(state, present, open_, other)


def exact_trials(
    state: State, present: Fit, timings: list[Timing], other: float = 0.0
) -> list[Trial]:
    """Refits with one of these timings more, the best of each name.

    other: the best gain of any other cause; what cannot come close to it is left out.
    """
    gains: list[tuple[float, Timing, Psi]] = []
    for timing in timings:
        psi, gain = state.coarse.best(timing, present, PROMISING * other)
        gains.append((gain, timing, psi))
    most = max(other, *(gain for gain, _, _ in gains))
    trials: dict[Key, Trial] = {}
    for gain, timing, psi in gains:
        if gain < CLOSE * most:
            continue
        revision = replace(present.revision, timings=(*present.revision.timings, (timing, psi)))
        now = fit(state.model, state.chunk, present.weights, revision, None, bank=False)
        if not _is_inside(now):
            continue
        exact, key = present.estimate.sse - now.estimate.sse, (timing.effect, "command")
        if key not in trials or exact > trials[key].gain:
            trials[key] = Trial(key, exact, now.revision, None, now)
    return list(trials.values())


def _is_inside(now: Fit) -> bool:
    """True where the timing that was added last did not end at a bound, nor at nothing."""
    timing, psi = now.revision.timings[-1]
    sd = now.estimate.sd(now.timing_columns(len(now.revision.timings) - 1)[0])
    return timing.low[0] * 1.01 < psi[0] < timing.high[0] * 0.99 and psi[0] > 3.0 * sd


def alike_ones(state: State, best: Trial, trials: list[Trial]) -> tuple[Key, ...]:
    """Causes that this record does not tell from the best one: all but as good.

    Where the best one leaves nothing but noise, one that leaves more is refuted.
    """
    close = best.gain - TIE - TIE_SHARE * best.gain
    settled = best.fit is not None and best.fit.rho < MATCH_RHO
    return tuple(
        t.key
        for t in trials
        if t.key != best.key
        and t.gain > close
        and t.key not in state.negligible
        and not (settled and t.fit is not None and t.fit.rho > MATCH_RHO)
    )


def _look_back(state: State, present: Fit, last: Residual) -> tuple[Fit, Residual]:
    """Drop what has become superfluous."""
    for effect in list(present.revision.effects) if len(present.revision.effects) > 1 else []:
        if any(effect.key == given.key for given in state.given):
            continue
        column = present.column(effect)
        estimate = present.estimate
        gain = (estimate.value(column) / max(estimate.sd(column), 1e-300)) ** 2
        possible = effect.is_possible(physical(present, effect, estimate.value(column)))
        if gain > GAIN and possible:
            continue
        kept = tuple(e for e in present.revision.effects if e != effect)
        revision = replace(present.revision, effects=kept)
        present = fit(state.model, state.chunk, present.weights, revision, present.map)
        last = residual(present, state.held_out)
        state.found = [f for f in state.found if f.key != effect.key]
        state.negligible.pop(effect.key, None)
    return present, last


NAMED = 0.8  # of the misfit that effects must explain to be named where something else remains


def _verdict(state: State, last: Fit, after: Residual) -> str:
    if last.regression.rows < 1000 or not len(last.map.cells):
        return INSUFFICIENT
    left = last.estimate.sse - last.regression.dof
    explained = 1.0 - left / state.excess if state.excess > 0 else 1.0
    is_explained = last.rho < MATCH_RHO or explained >= NAMED
    if not state.found:
        # what is left behind effects too small to matter is too small to matter itself
        small = bool(state.given or state.negligible) and remainder(after) < MATERIAL
        return MATCHES if last.rho < MATCH_RHO or small else UNKNOWN
    if not is_explained:
        return UNKNOWN
    return AMBIGUOUS if any(f.alike for f in state.found[:1]) else MISSING


def remainder(held: Residual) -> float:
    """What a residual has beyond the sensors' noise, of the rms flow."""
    left = max(0.0, held.rms_m3s**2 - held.floor_m3s**2)
    return float(np.sqrt(left) / max(held.flow_m3s, 1e-12))


def detection_limit(score: Score, rho: float) -> float:
    """Smallest size that the record would have shown."""
    return LIMIT_SD * score.sd * float(np.sqrt(max(1.0, rho)))
