"""Causes on trial: each one beside the model so far, and what chi2 would fall by with it.

Causes with a column of their own are scored in the one regression; timing effects are refitted
exactly where something large is left, because a bent map misleads their derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from rtid.diagnose.candidates import Candidate
from rtid.diagnose.causes import causes
from rtid.diagnose.fit import Fit, fit, one_pass, tried
from rtid.diagnose.parts import Part
from rtid.diagnose.pump import PUMP, demand
from rtid.diagnose.regression import LIMIT_SD, Score
from rtid.diagnose.residual import Residual, residual
from rtid.diagnose.revision import Revision
from rtid.diagnose.search import Beside, Search
from rtid.diagnose.timing import COMMAND, TIMINGS, Psi, Timing
from rtid.model import FloatArray, Model

GAIN = 16.0  # chi2 of the first effect: 60 candidates, 0.4 % for all of them together
LARGE = 1.5  # rho above which timing effects are refitted whatever their score
TIE, TIE_SHARE = 12.0, 0.03  # causes within so much of the best gain are not told apart
REFUTED, WITHIN = 3.0, 0.05  # times the best cause's misfit; least misfit, of dof
CLOSE = 0.9  # timings whose coarse gain is this share of the best are refitted finely
PROMISING = 0.3  # share of the best gain that a timing's bank must reach to be closed in on
SHARE_OF_BEST = 0.2  # of the best gain that a cause must have for its shape to be refined
ROUNDS = 8  # of refinement, each with half the step of the last
SETTLED = 2e-3  # of the gain: what a round must add for another one
MATCH_RHO = 1.10  # largest rho of a model that matches

# pumps to begin with: droops as shares of that seen, quantiles of the demand, stiffness in Pa/m3
DROOPS, PUMP_LIMITS, STIFFNESSES = (0.1, 0.7), (0.8, 0.93, 0.98), (1e9, 1e10, 1e11, 1e12)

Key = tuple[str, str]


@dataclass(frozen=True)
class Trial:
    """A cause beside the model so far: what chi2 would fall by, and the revision with it.

    fit: an exact refit, where there is one; is_timing: it transforms a command or the supply.
    """

    key: Key
    gain: float
    revision: Revision
    fit: Fit | None = None
    is_timing: bool = False

    @property
    def n_parameters(self) -> int:
        """Parameters that the cause brings."""
        if self.is_timing:
            return len(self.revision.timings[-1][1])
        return 1 + len(self.effect.shape)

    @property
    def effect(self) -> Candidate:
        """The candidate of a cause with a column of its own."""
        return self.revision.effects[-1]


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


def scored(fit_: Fit) -> list[tuple[Candidate, Score]]:
    """Every candidate that is not part of the revision, beside it."""
    used = fit_.estimate.used
    return [
        (candidate, fit_.regression.score(used, fit_.first + k))
        for k, candidate in enumerate(fit_.columns.candidates)
        if candidate not in fit_.revision.effects
    ]


def trials_of(state: State, present: Fit) -> list[Trial]:
    """Every possible cause with its best shape: fixed columns, and timings where they matter."""
    best = best_by_key(present, scored(present))
    trials = []
    for key, (candidate, score) in best.items():
        if key[1] == COMMAND:
            continue
        trials.append(Trial(key, score.gain, _with(present, candidate)))
    trials = with_pump(state, present, refined(state, present, trials))
    scores = {key: s.gain for key, (_, s) in best.items() if key[1] == COMMAND}
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
        if present.revision.has(candidate.key):
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
    return float(value * np.mean(fit_.weights.compliance[at]) / np.mean(fit_.compliance[at]))


def refined(state: State, present: Fit, trials: list[Trial]) -> list[Trial]:
    """Shapes between those of the bank, where they could matter: one pass per round for all."""
    bar = max(GAIN, SHARE_OF_BEST * max((t.gain for t in trials), default=0.0))
    at = {t.key: t for t in trials}
    open_ = {t.key for t in trials if t.effect.shape and t.gain > bar}
    for k in range(ROUNDS):
        if not open_:
            break
        effects = {key: at[key].effect for key in open_}
        more = [
            (cause, shape)
            for cause in causes(present.view)
            if cause.candidate.key in effects and cause.makes(effects[cause.candidate.key])
            for shape in cause.about(effects[cause.candidate.key].shape, 0.5**k)
        ]
        finer = one_pass(
            state.model, state.chunk, present.weights, present.revision, present, False, more
        )
        best = best_by_key(finer, scored(finer))
        for key in list(open_):
            candidate, score = best.get(key, (at[key].effect, None))
            rise = score.gain - at[key].gain if score is not None else 0.0
            if score is not None and rise > 0:
                at[key] = replace(at[key], gain=score.gain, revision=_with(present, candidate))
            if rise < max(TIE, SETTLED * at[key].gain):
                open_.discard(key)
    return list(at.values())


def _with(present: Fit, candidate: Candidate) -> Revision:
    return replace(present.revision, effects=(*present.revision.effects, candidate))


def with_pump(state: State, present: Fit, trials: list[Trial]) -> list[Trial]:
    """A supply that sags is refitted exactly, from where its first-order forms point."""
    first = [t for t in trials if t.effect.effect == PUMP.effect]
    rest = [t for t in trials if t.effect.effect != PUMP.effect]
    if not first or first[0].gain < PROMISING * max((t.gain for t in rest), default=0.0):
        return rest
    psi = state.coarse.beside(present).polished(PUMP, _pumps(present))
    timings = (*present.revision.timings, (PUMP, psi))
    revision = replace(present.revision, timings=timings)
    now = fit(state.model, state.chunk, present.weights, revision, bank=False)
    gain = present.estimate.sse - now.estimate.sse
    return [*rest, Trial(first[0].key, gain, now.revision, now.light(), True)]


def _pumps(present: Fit) -> list[Psi]:
    """Pumps to begin with: droops about the one that is seen, limits within what is drawn."""
    drawn = demand(present.view)
    resistances = [
        score.value
        for candidate, score in scored(present)
        if candidate.effect == PUMP.effect and candidate.parameter == "resistance"
    ]
    r = max([*resistances, PUMP.low[0]])
    limits = [*np.quantile(drawn[drawn > 0], PUMP_LIMITS), 2.0 * drawn.max()]
    return [(float(r * part), float(q), s) for part in DROOPS for q in limits for s in STIFFNESSES]


def _timing_trials(
    state: State, present: Fit, scores: dict[Key, float], other: float
) -> list[Trial]:
    """Exact refits with one timing more, of those that may matter."""
    open_ = [t for t in TIMINGS if not present.revision.has((t.effect, COMMAND))]
    if present.rho < LARGE:
        open_ = [t for t in open_ if scores.get((t.effect, COMMAND), 0.0) > GAIN]
    if not open_ or not present.view.has_pressures:
        return []
    return exact_trials(state, present, open_, other)


def exact_trials(
    state: State, present: Fit, timings: list[Timing], other: float = 0.0
) -> list[Trial]:
    """Refits with one of these timings more, the best of each name.

    other: the best gain of any other cause; what cannot come close to it is left out.
    """
    gains = _from_afar(state.coarse.beside(present), timings, other)
    most = max([other, *(gain for gain, _, _ in gains)])
    trials: dict[Key, Trial] = {}
    for gain, timing, psi in gains:
        if gain < CLOSE * most:
            continue
        revision = replace(present.revision, timings=(*present.revision.timings, (timing, psi)))
        now = tried(state.model, state.chunk, present.weights, revision)
        if not _is_inside(now):
            continue
        exact, key = present.estimate.sse - now.estimate.sse, (timing.effect, COMMAND)
        if key not in trials or exact > trials[key].gain:
            trials[key] = Trial(key, exact, now.revision, now, True)
    return list(trials.values())


def carried_on(state: State, present: Fit, trial: Trial) -> Fit:
    """The fit with a trial's revision, to the end."""
    revision, weights, start = trial.revision, present.weights, present
    if trial.fit is not None:
        weights, start = trial.fit.weights, trial.fit
    return fit(state.model, state.chunk, weights, revision, start, bank=False)


def _from_afar(
    coarse: Beside, timings: list[Timing], other: float
) -> list[tuple[float, Timing, Psi]]:
    """Gain and parameters of every promising timing on the coarse map; one of each name."""
    banks = {timing: coarse.bank(timing) for timing in timings}
    bar = PROMISING * max([other, *(max(bank.values()) for bank in banks.values())])
    best: dict[str, tuple[float, Timing, Psi]] = {}
    for timing, bank in banks.items():
        if max(bank.values()) < bar or max(bank.values()) <= 0.0:
            continue
        psi, gain = coarse.closed_in(timing, bank)
        if timing.effect not in best or gain > best[timing.effect][0]:
            best[timing.effect] = gain, timing, psi
    return list(best.values())


def _is_inside(now: Fit) -> bool:
    """True where the timing that was added last did not end at a bound, nor at nothing."""
    timing, psi = now.revision.timings[-1]
    sd = now.estimate.sd(now.timing_columns(len(now.revision.timings) - 1)[0])
    return timing.low[0] * 1.01 < psi[0] < timing.high[0] * 0.99 and psi[0] > 3.0 * sd


def alike_ones(state: State, present: Fit, best: Trial, trials: list[Trial]) -> tuple[Key, ...]:
    """Causes that this record does not tell from the best one: all but as good.

    One that leaves several times the misfit that the best one leaves is refuted.
    """
    dof = present.regression.dof
    misfit = present.estimate.sse - dof
    close = best.gain - TIE - TIE_SHARE * best.gain
    refuted = misfit - REFUTED * max(misfit - best.gain, WITHIN * dof) - TIE
    return tuple(
        t.key
        for t in trials
        if t.key != best.key and t.gain > max(close, refuted) and t.key not in state.negligible
    )


def contest(
    state: State, present: Fit, best: Trial, trials: list[Trial]
) -> tuple[Trial, tuple[Key, ...]]:
    """The cause to add, and those that this record does not tell from it.

    Where several look alike each is refitted to the end, and the best of them is asked again; among
    equals the one with the fewest parameters is taken.
    """
    rivals = [t for t in trials if t.key in alike_ones(state, present, best, trials)]
    if not rivals:
        return best, ()
    refitted = [_finished(state, present, t) for t in (best, *rivals)]
    best = max(refitted, key=lambda t: t.gain)
    alike = alike_ones(state, present, best, refitted)
    equals = [best, *(t for t in refitted if t.key in alike)]
    chosen = min(equals, key=lambda t: (t.n_parameters, -t.gain))
    return chosen, tuple(t.key for t in equals if t.key != chosen.key)


def _finished(state: State, present: Fit, trial: Trial) -> Trial:
    now = carried_on(state, present, trial)
    gain = present.estimate.sse - now.estimate.sse
    return replace(trial, gain=gain, revision=now.revision, fit=now.light())


def material_share(before: Residual, after: Residual) -> float:
    """What an effect takes off the held-out residual, root of the difference, of the rms flow."""
    gone = before.rms_m3s**2 - after.rms_m3s**2
    return float(np.sqrt(max(0.0, gone)) / max(before.flow_m3s, 1e-12))


def own_share(now: Fit, trial: Trial, held_out: FloatArray) -> float:
    """Size of an effect's own flow on the held-out part, of the rms flow; inf for a timing."""
    if trial.is_timing:
        return float("inf")
    effect = now.revision.effects[-1]
    whole = residual(now, held_out)
    without = residual(now, held_out, leave_out=effect)
    change = whole.left - without.left
    return float(np.sqrt(np.mean(change**2)) / max(whole.flow_m3s, 1e-12)) if change.size else 0.0


def detection_limit(score: Score, rho: float) -> float:
    """Smallest size that the record would have shown."""
    return LIMIT_SD * score.sd * float(np.sqrt(max(1.0, rho)))
