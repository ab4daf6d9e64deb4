"""Which physical effect is missing: score all, add the best, look back, and say what is not known.

Each round puts every candidate on trial beside the model so far.  The best is added if it is
significant, possible and material; when nothing more is, the verdict follows from what is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from rtid.diagnose.candidates import Candidate
from rtid.diagnose.clean import as_measured, usable
from rtid.diagnose.contest import contest, trials_of
from rtid.diagnose.exact import carried_on
from rtid.diagnose.fit import Fit, fit, one_pass, prepare, with_covariances
from rtid.diagnose.parts import Part, recall
from rtid.diagnose.regression import Score
from rtid.diagnose.residual import Residual, residual
from rtid.diagnose.revision import Revision
from rtid.diagnose.trials import (
    GAIN,
    MATCH_RHO,
    Found,
    Key,
    State,
    Trial,
    material_share,
    own_share,
    physical,
    scored,
)
from rtid.diagnose.verdict import MATERIAL, NAMED, UNKNOWN, can_judge, verdict
from rtid.model import FloatArray, Model

LATER_GAIN = 25.0  # chi2 of every effect behind the first
MOST = 6  # effects that are added at most
WORSE = 1.02  # held-out residual, as a share, that an immaterial effect may not raise
BENT = 3.0  # times its own flow that an effect may gain: it also bends the maps when it is missing
MOST_NEGLIGIBLE = 4  # that are looked at
NOTICED = 0.01  # of the degrees of freedom: chi2 from which an immaterial effect stays in the model
SHARE = 0.4  # of the misfit left that a cause must explain, once most of the first is explained,
LEAST_SHARE = 0.1  # ... and before


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
    before = residual(first, state.held_out)
    judged = can_judge(before)
    if not judged:
        state.held_out = state.chunk
        before = residual(first, state.held_out)
    bare = _bare(state, first)
    state.excess = bare.held.sse - bare.regression.dof
    present, first, last = first, first.light(), before
    if can_judge(before):
        present, last = _extended(state, present, before)
    said = verdict(state, first, present, last, judged)
    if said == UNKNOWN:  # what explains a part of it only is not named, and not counted
        present, last, state.found = first, before, []
    found, negligible = tuple(state.found), state.negligible
    return Result(
        first, present.light(), found, negligible, scored(present), before, last, said, parts,
        held_out_judged=judged,
    )  # fmt: skip


def _extended(state: State, first: Fit, before: Residual) -> tuple[Fit, Residual]:
    """The model with every effect that deserves it, and what it leaves of the held-out part."""
    present, last = first, before
    for k in range(MOST):
        state.progress("scoring", 0.1 + 0.8 * k / MOST)
        added = _add_best(state, present, last)
        if added is None:
            break
        present, last = added
    return _look_back(state, present, last)


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


def _add_best(state: State, present: Fit, last: Residual) -> tuple[Fit, Residual] | None:
    """Add the best cause that is significant and material; None when there is none.

    One that is significant but changes next to nothing is only listed, unless it explains a part of
    the misfit that would be found in another guise.
    """
    least = LATER_GAIN if state.found or state.given else GAIN
    trials = [t for t in trials_of(state, present) if t.gain > least]
    for best in sorted(trials, key=lambda t: -t.gain):
        if best.key in state.negligible or len(state.negligible) == MOST_NEGLIGIBLE:
            continue
        if not _explains(state, present, best):
            return None
        trial, alike = contest(state, present, best, trials)
        now = with_covariances(carried_on(state, present, trial), like=present)
        after = residual(now, state.held_out)
        own = BENT * own_share(now, trial, state.held_out)
        share = min(material_share(last, after), own)
        if share >= MATERIAL:
            kept, after = _with_bank(state, now)
            state.found.append(Found(trial.key, alike, trial.gain, trial.n_parameters, last, after))
            return kept, after
        state.negligible[trial.key] = share
        if _is_noticed(present, trial) and after.rms_m3s <= WORSE * last.rms_m3s:
            state.negligible |= dict.fromkeys(alike, share)
            return _with_bank(state, now)
        del now  # its rows are large
    return None


def _with_bank(state: State, now: Fit) -> tuple[Fit, Residual]:
    """A fit with every candidate beside it, and what it leaves of the held-out part."""
    kept = one_pass(state.model, state.chunk, now.weights, now.revision, now, bank=True)
    return kept, residual(kept, state.held_out)


def _is_noticed(present: Fit, trial: Trial) -> bool:
    """True for an immaterial cause that explains a fair part of the misfit all the same."""
    dof = present.regression.dof
    return trial.gain > max(NOTICED * dof, LEAST_SHARE * (present.held.sse - dof))


def _explains(state: State, present: Fit, trial: Trial) -> bool:
    """False where a cause is a small part of what is left behind an effect of the wrong form.

    Once most of the first misfit is explained, the rest of a form that is nearly right would be
    named as effects of their own.
    """
    left = present.held.sse - present.regression.dof
    excess = state.excess
    if present.rho < MATCH_RHO or excess <= 0:
        return True
    return trial.gain > (SHARE if left < (1 - NAMED) * excess else LEAST_SHARE) * left


def _look_back(state: State, present: Fit, last: Residual) -> tuple[Fit, Residual]:
    """Drop what has become superfluous."""
    for effect in list(present.revision.effects) if len(present.revision.effects) > 1 else []:
        if any(effect.key == given.key for given in state.given):
            continue
        column, estimate = present.column(effect), present.estimate
        own = {column, *present.shape_columns(effect).values()}
        without = present.regression.fit(tuple(k for k in estimate.used if k not in own))
        possible = effect.is_possible(physical(present, effect, estimate.value(column)))
        if without.sse - estimate.sse > GAIN and possible:
            continue
        kept = tuple(e for e in present.revision.effects if e != effect)
        revision = replace(present.revision, effects=kept, sizes=())
        present = fit(state.model, state.chunk, present.weights, revision, present)
        last = residual(present, state.held_out)
        state.found = [f for f in state.found if f.key != effect.key]
        state.negligible.pop(effect.key, None)
    return present, last
