"""Which physical effect is missing: score all, add the best, look back, and say what is not known.

Each round puts every candidate on trial beside the model so far.  The best is added if it is
significant, possible and material; when nothing more is, the verdict follows from what is left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rtid.diagnose.admission import (
    clearest_gain,
)
from rtid.diagnose.attenuation import apart_from_noise
from rtid.diagnose.consequence import (
    ALIKE,
)
from rtid.diagnose.excuse import counting
from rtid.diagnose.finer import finer_beside
from rtid.diagnose.fit import Fit, fit
from rtid.diagnose.held_again import held_again
from rtid.diagnose.joined import joints
from rtid.diagnose.nameable import Reach, known_as_moduli, reaches
from rtid.diagnose.one_round import add_best
from rtid.diagnose.overlap import beside_openings
from rtid.diagnose.parts import AddedEffect
from rtid.diagnose.regression import Score
from rtid.diagnose.residual import Residual
from rtid.diagnose.revision import Revision
from rtid.diagnose.sized import physical
from rtid.diagnose.softer import Softer, softer
from rtid.diagnose.spread import with_spreads
from rtid.diagnose.standing import Standing, on_its_grid, stand
from rtid.diagnose.trials import (
    GAIN,
    AcceptedEffect,
    TrialState,
    scored,
)
from rtid.diagnose.verdict import (
    AMBIGUOUS,
    INSUFFICIENT,
    MATCHES,
    MISSING,
    NAMED,
    UNKNOWN,
    can_judge,
    explained,
    foretells,
    is_slight,
    told_doubts,
    verdict,
)
from rtid.diagnose.zeros import Zero, zeros
from rtid.effects.column import Candidate
from rtid.effects.laws.lines import lines_at, stores_at
from rtid.effects.page import Effect
from rtid.estimator.factor import on_one_thread
from rtid.estimator.validity import Doubt
from rtid.model import Machine
from rtid.plain import FloatArray, Key, Progress, silent

MOST = 6  # effects that are added at most


@dataclass(frozen=True)
class Result:
    """The first and the last fit, what was given before, added on the way, and left."""

    first: Fit
    last: Fit
    found: tuple[AcceptedEffect, ...]
    negligible: dict[Key, float]
    scores: list[tuple[Candidate, Score]]
    before: Residual
    after: Residual
    verdict: str
    given: tuple[AddedEffect, ...] = ()
    held_out_judged: bool = True  # False: too little of it is known, and the record itself judged
    zeros: tuple[Zero, ...] = ()  # of the pressure sensors, where valves have joined them at rest
    # of what was not found: the column that tells it, and what it does
    reach: Mapping[Key, tuple[Candidate, Reach]] = field(default_factory=dict)
    doubts: tuple[Doubt, ...] = ()  # of the last fit's moduli, by what its blocks miss
    softer: Softer | None = None  # a chamber that stores more than its oil, by the other one


def search(
    model: Machine,
    chunk: FloatArray,
    held_out: FloatArray,
    progress: Progress = silent,
    parts: tuple[AddedEffect, ...] = (),
    suspects: tuple[Effect, ...] = (),
) -> Result:
    """Diagnose a record; chunk and held_out (n, 2 + signals), SI, as from `to_chunk`.

    parts: effects that the model has already; suspects: effects of the user's that are scored
    beside those of the catalogue.  Raises PartError where the record has none of them.
    Where the map is known over next to nothing of the held-out part, the record itself judges; and
    where it is known over next to nothing of that, all of it: what is named then is, nothing else.
    """
    return searched(stand(model, chunk, held_out, parts, progress, suspects=suspects), progress)


@on_one_thread
def searched(standing: Standing, progress: Progress = silent) -> Result:
    """Diagnose a record, from the model as it stands on."""
    first, parts = standing.fit, standing.state.given
    state = standing.state.anew(progress)
    record = state.chunk, state.held_out
    before, judged = _judging(state, first, standing.held_out)
    state.excess = _excess(state, first)
    present, first, last = first, first.light(), before
    if can_judge(before):
        present, last = _extended(state, present, before)
        if (finer := _on_finer_grid(state, present, last)) is not None:
            rest, is_judged = _judging(state, finer, state.left(finer))
            if judged and not is_judged:
                before, judged = state.left(first), False
            present, last = _extended(state, finer, rest)
        if judged and not can_judge(last):  # as found, spools pass through blocks that it lacks
            last, judged = _judging(state, present, last)
            before = state.left(first)
    if judged and present.declared.has_pressures and not (state.found or foretells(last)):
        before, last = _as_taught(state, first, present) or (before, last)
    state.found = [beside_its_line(state, told_apart(state, effect)) for effect in state.found]
    state.found = beside_openings(state.found, present)
    doubted = told_doubts(present)
    said = verdict(state, first, present, last, doubted, judged)
    soft = stored(state, first, present, said)
    if soft is not None:
        said = AMBIGUOUS
        state.negligible = {k: v for k, v in state.negligible.items() if k not in soft.causes}
    if said == UNKNOWN:  # what explains a part of it only is not named, and not counted
        doubted = told_doubts(first) if state.found else doubted
        present, last, state.found = first, before, []
    elif not state.found and (soft or matches_as_it_stands(first, present)):
        present, last, doubted = standing.fit, before, told_doubts(first)
    named = {f.key for f in state.found} | {part.key for part in parts}
    present = with_spreads(present, frozenset(e.key for e in present.revision.effects) - named)
    result, negligible, scores = tuple(state.found), state.negligible, scored(present)
    joined = tuple(joint for part in record for joint in joints(present, part, scores))
    apart = zeros(present, joined)
    if said == MATCHES and any(zero.matters for zero in apart):
        said = MISSING
    reach: dict[Key, tuple[Candidate, Reach]] = {}
    if said != INSUFFICIENT:
        present = counting(present)
        scores, nothing = apart_from_noise(present, scores)
        negligible = {key: share for key, share in negligible.items() if key not in nothing}
        scores = known_as_moduli(present, scores)
        reach = reaches(present, scores, last.flow_m3s, clearest_gain(result))
    present = present.unfactored(always=True).light()  # others are made beside it
    return Result(
        first, present, result, negligible, scores, before, last, said, parts,
        held_out_judged=judged, zeros=apart, reach=reach, doubts=doubted,
        softer=soft,
    )  # fmt: skip


def _judging(state: TrialState, first: Fit, unseen: Residual) -> tuple[Residual, bool]:
    """What a fit leaves of the part that judges, and whether that is the held-out one.

    unseen: what it leaves of that.  Where its map is known over next to nothing there, the record
    judges, and where over next to nothing of that, all of it.
    """
    if can_judge(unseen):
        return unseen, True
    state.held_out = state.chunk
    rest = state.left(first)
    if not can_judge(rest):
        state.judges_itself = True
        rest = state.left(first)
    return rest, False


def _as_taught(state: TrialState, first: Fit, present: Fit) -> tuple[Residual, Residual] | None:
    """What the first and the last fit leave of motion like that which taught their maps.

    None where there is too little of that.  A valve that opens in the middle of a block left ten
    times the floor of a healthy machine, nearly all of it in a quarter of a second below the part
    of the block that had been visited, and 1.5 times of what was like it.
    """
    state.as_taught = True
    before, last = state.left(first), state.left(present)
    state.as_taught = can_judge(before) and can_judge(last)
    return (before, last) if state.as_taught else None


def _on_finer_grid(state: TrialState, present: Fit, last: Residual) -> Fit | None:
    """The fit that a search begins with, on the grid that the record needs beside what was found.

    What is missing hides what the grid misses: a valve that opens with a jump had no border there,
    as it would have had without the line before its cylinder, which took 79 % of the misfit and so
    was not named.  None where nothing was found, where the grid does, or where what explains most
    has a name and leaves what is immaterial: a finer map is known over less of the record.
    """
    if not state.found or present.rho < present.most_rho:
        return None
    if is_slight(last) and explained(state, present) >= NAMED:
        return None
    finer = finer_beside(present.light())
    if finer.declared is present.declared:
        return None
    again = _without(state, finer.light())
    del finer  # its rows are large
    state.begin(again.state.model)
    state.excess = _excess(state, again.fit)
    return again.fit


def _without(state: TrialState, beside: Fit) -> Standing:
    """The model without what was found, on the grid that the record needs beside it, or a finer.

    Not on a finer one that leaves more than what was found does on its own: of a spool that moves
    at 20 strokes a second at most the maps of 840 blocks more had followed all, by 213 of chi2 less
    well than two numbers, and the record matched.
    """
    parts = state.given, state.progress
    again = stand(beside.declared, state.chunk, state.held_out, *parts, suspects=state.suspects)
    if again.state.model.n_cells > beside.declared.n_cells and beside.wins_over(again.fit) > 0.0:
        bare = on_its_grid(beside.declared, state.chunk, state.given, state.suspects)
        return stand(bare.declared, bare.chunk, state.held_out, *parts, bare, state.suspects)
    return again


def stored(state: TrialState, first: Fit, last: Fit, said: str) -> Softer | None:
    """What a chamber stores more, where nothing is named and the other one tells it.

    last: with what was seen and is not named; said: the verdict so far.  Where the record does not
    match as it stands, this must explain most of its misfit.
    """
    if state.found or said not in (MATCHES, UNKNOWN):
        return None
    soft = softer(first)
    if soft is None or any(part.key in soft.causes for part in state.given):
        return None
    if first.rho < first.most_rho:
        return soft
    of_it = last.revision.effects and all(e.key in soft.causes for e in last.revision.effects)
    return soft if of_it and explained(state, last) >= NAMED else None


def matches_as_it_stands(first: Fit, last: Fit) -> bool:
    """True where a model needs nothing of what was seen and does not matter, the last fit's.

    Then all is told of the model as it stands: the maps that are published, its moduli, what each
    cause must be to be seen.  A line that was kept beside it gave 1487 MPa where 991 was known to
    1 %; and beside a lag that was kept, a delay of 0.1 ms would have been seen.
    """
    is_same = first.revision == last.revision
    return not is_same and first.rho < first.most_rho and not told_doubts(first)


def told_apart(state: TrialState, effect: AcceptedEffect) -> AcceptedEffect:
    """What was found as well, beside an effect, is no rival of it: both are needed."""
    found = {other.key for other in state.found}
    return replace(effect, alike=tuple(key for key in effect.alike if key not in found))


def beside_its_line(state: TrialState, stored: AcceptedEffect) -> AcceptedEffect:
    """What is stored beside the inertance of a line is not told from the line's own oil and wall.

    The line of 1.2 m that left 1.61e-4 m3 was named a dead volume of 1.70e-4 m3 and an inertance.
    """
    where = stored.key[1]
    if stored.key not in stores_at(where):
        return stored
    beside = [f.key for f in state.found] + [part.key for part in state.given]
    lines = [key for key in beside if key in lines_at(where)]
    return replace(stored, alike=tuple(dict.fromkeys((*stored.alike, *lines))))


def _extended(state: TrialState, first: Fit, before: Residual) -> tuple[Fit, Residual]:
    """The model with every effect that deserves it, and what it leaves of the held-out part.

    Anew where a timing had stood in for what was found beside it: what that is was judged with it.
    """
    present, last = _grown(state, first, before)
    while (key := _stood_in(state, present)) is not None:
        state.ruled_out.add(key)
        state.found, state.negligible = [], {}
        del present  # its rows are large
        present, last = _grown(state, first, before)
    again = held_again(state, present)
    if again is not present:
        present, last = again, state.left(again)
    return _look_back(state, present, last)


def _grown(state: TrialState, first: Fit, before: Residual) -> tuple[Fit, Residual]:
    """The model with one effect after the other, as long as one deserves it."""
    present, last = first, before
    for k in range(MOST):
        state.progress("scoring", 0.1 + 0.8 * k / MOST)
        added = add_best(state, present, last)
        if added is None:
            break
        if present.rows is not None and present.rows is not added[0].rows:
            present.rows.forget()  # who asked holds on to the first fit
        first.at_rest()
        present, last = added
    return present, last


def _stood_in(state: TrialState, present: Fit) -> Key | None:
    """A timing that does as little as one can beside what was found later, and is not missed.

    A leak between the chambers was a hysteresis of 5.6 mV on a slow sweep, which went to 5 mV, the
    least of its page, when the leak was put beside it: too small to matter, there.
    """
    timings, more = present.revision.timings, present.revision.n_causes > 1
    for timing, psi in timings if more else ():
        known = next((f for f in state.found if timing.is_at(*f.key)), None)
        if known is None or not timing.is_least(psi):
            continue
        revision = replace(present.revision, timings=tuple(t for t in timings if t[0] != timing))
        weights = replace(present.weights, lag_s=state.model.lag.nominal_s)
        without = fit(state.model, state.chunk, weights, revision, present, bank=False)
        least = max(GAIN * known.n_parameters, ALIKE**2 * known.gain)
        if present.wins_over(without) < least:
            return known.key
    return None


def _excess(state: TrialState, first: Fit) -> float:
    """chi2 beyond the noise that a fit without any effect leaves."""
    bare = first
    if state.given:
        weights = replace(first.weights, lag_s=state.model.lag.nominal_s)
        bare = fit(state.model, state.chunk, weights, Revision(), bank=False)
    return bare.held.sse - bare.regression.dof


def _look_back(state: TrialState, present: Fit, last: Residual) -> tuple[Fit, Residual]:
    """Drop what has become superfluous, one by one: the fit without it may move all the others."""
    while (effect := _superfluous(state, present)) is not None:
        kept = tuple(e for e in present.revision.effects if e != effect)
        revision = replace(present.revision, effects=kept, sizes=())
        present = fit(
            state.model, state.chunk, present.weights, revision, present, suspects=state.suspects
        )
        last = state.left(present)
        state.found = [f for f in state.found if f.key != effect.key]
        state.negligible.pop(effect.key, None)
    return present, last


def _superfluous(state: TrialState, present: Fit) -> Candidate | None:
    """The first effect of several that the others explain as well, or whose size is impossible.

    One that explains a hundredth of what it took when it was found had stood in for another, and
    what is left of it is within that one's form: a pressure that was 1.08 ms slow was a dead volume
    of 0.51 L in the other chamber, and 0.03 L of it took 214 of 80,500 of chi2 beside it.
    """
    effects, estimate = present.revision.effects, present.estimate
    given = {part.key for part in state.given}
    gains = {f.key: f.gain for f in state.found}
    for effect in effects if len(effects) + len(present.revision.timings) > 1 else ():
        column = present.column(effect)
        columns = {column, *present.shape_columns(effect).values()}
        without = present.regression.fit(tuple(k for k in estimate.used if k not in columns))
        possible = effect.is_possible(physical(present, effect, estimate.value(column)))
        least = max(GAIN, ALIKE**2 * gains.get(effect.key, 0.0))
        is_needed = without.sse - estimate.sse > least and possible
        if effect.key not in given and not is_needed:
            return effect
    return None
