"""Add one effect by name: fit the model without and with it, and hold both against both parts.

Shapes and timings are found as the diagnosis finds them; whether the effect deserves its place is
judged by the same limits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rtid.diagnose.admission import LEAST_SHARE, taken_in
from rtid.diagnose.contest import alike_ones
from rtid.diagnose.diagnosis import Result
from rtid.diagnose.exact import carried_on, exact_trials, is_inside, key_of, with_pump
from rtid.diagnose.excuse import few_excused
from rtid.diagnose.fit import MATCH_RHO
from rtid.diagnose.report import Value
from rtid.diagnose.sized import physical
from rtid.diagnose.softer import softer
from rtid.diagnose.spread import with_spreads
from rtid.diagnose.standing import Standing, with_bank
from rtid.diagnose.trials import (
    GAIN,
    TIE,
    TIE_SHARE,
    Trial,
    best_by_key,
    material_share,
    own_share,
    refined,
    scored,
)
from rtid.diagnose.verdict import MATERIAL
from rtid.effects.laws.pump import PUMP
from rtid.effects.laws.sensors import sensor_timings
from rtid.effects.laws.timing import COMMAND, timings_of
from rtid.errors import RtidError
from rtid.plain import Key
from rtid.units import nearest

UNJUDGED = "the held-out part has no place where the map is known well enough to judge"


class RefusedError(RtidError):
    """The effect cannot be added, or does not deserve it; the text has the figures."""

    exit_code = 4


@dataclass(frozen=True)
class Extension:
    """An effect that was tried: chi2 fell by `gain`; against: why it should not be added.

    better: in plain words, a cause that would explain clearly more, else empty; sizes: parameters
    of what is no part of the fit.
    """

    key: Key
    gain: float
    before: Standing
    after: Standing
    against: tuple[str, ...]
    better: str
    sizes: Mapping[str, Value] = field(default_factory=dict)


def extend(present: Standing, effect: str, where: str = "") -> Extension:
    """The model with one effect more, at the place where it explains most unless one is named.

    Raises RefusedError where the machine or the record offers no such effect, where its size would
    be impossible, and where several places explain the same.
    """
    state = present.state
    trials = _timings(present, effect, where) or _flows(present, effect, where)
    if effect == PUMP.effect:
        trials = with_pump(state, present.fit, trials)
    best = max(trials, key=lambda t: t.gain)
    alike = alike_ones(state, present.fit, best, trials)
    if alike:
        choices = " or ".join(f"{effect}:{place}" for _, place in (best.key, *alike))
        raise RefusedError(f"{effect} explains as much at several places", f"name one: {choices}")
    now = carried_on(state, present.fit, best)
    after = Standing(state, with_spreads(with_bank(few_excused(now), state.suspects)))
    against = tuple(_against(present, after, best))
    better = (against and _declared(present, best)) or _better(present, best)
    tried = Extension(best.key, best.gain, present, after, against, better)
    if best.is_timing and effect != PUMP.effect and best.fit and not is_inside(best.fit):
        raise _nothing(tried)
    return tried


def as_diagnosed(present: Standing, result: Result, key: Key) -> Extension | None:
    """The model with what alone its diagnosis has added: its last fit is the one of `extend`.

    None where that began elsewhere, as from a form that was looked for or a refit among rivals.
    """
    before, after = present.fit.revision, result.last.revision
    is_alone = [effect.key for effect in result.found] == [key]
    if not is_alone or len(before.timings) != len(after.timings):
        return None
    added = after.effects[len(before.effects) :]
    scores = {candidate: score.gain for candidate, score in scored(present.fit)}
    if len(added) != 1 or added[0].shape or scores.get(added[0]) != result.found[0].gain:
        return None
    trial = Trial(key, result.found[0].gain, after)
    having = Standing(present.state, result.last)
    against = tuple(_against(present, having, trial))
    return Extension(key, trial.gain, present, having, against, _better(present, trial))


def _declared(present: Standing, trial: Trial) -> str:
    """How to have an effect that a modulus tells and its rows do not; "" where there is none."""
    told_by_modulus = softer(present.fit)
    if told_by_modulus is None or trial.key not in told_by_modulus.causes:
        return ""
    return told_by_modulus.remedy


def _nothing(tried: Extension) -> RefusedError:
    """A timing whose fit ends at nothing or at a bound is no cause, by force neither."""
    effect, where = tried.key
    return RefusedError(
        f"{effect} at {where}: the fit ends at nothing, or at a bound; {'; '.join(tried.against)}",
        f"{tried.better}; ".lstrip("; ") + "`rtid diagnose` says what this record would have shown",
    )


def _timings(present: Standing, effect: str, where: str) -> list[Trial]:
    """Refits with a timing of that name; none if there is no such timing."""
    model = present.state.model
    all_timings = (*timings_of(model, present.state.chunk), *sensor_timings(model))
    timings = [t for t in all_timings if t.effect == effect]
    if not timings:
        return []
    _refuse_place(effect, where, [t.where for t in timings])
    taken = [t.where for t in timings if present.fit.revision.has(key_of(t))]
    timings = [t for t in timings if t.where not in taken and where in ("", t.where)]
    if not timings:
        raise _already(effect, taken[0])
    state, fit = present.state, present.fit
    return exact_trials(state, fit, timings) or exact_trials(state, fit, timings, anywhere=True)


def _flows(present: Standing, effect: str, where: str) -> list[Trial]:
    """The columns of that name, each with its best shape."""
    fit_ = present.fit
    offered = [(c, s) for c, s in scored(fit_) if c.effect == effect]
    taken = [e.where for e in fit_.revision.effects if e.effect == effect]
    places = list(dict.fromkeys([*taken, *(c.where for c, _ in offered)]))
    if not places:
        raise RefusedError(
            f"{effect} has no column in the pressure equations of this machine and record",
            f"`rtid effects {effect}` says what it acts on and which signals it needs",
        )
    _refuse_place(effect, where, places)
    if where in taken or set(places) == set(taken):
        raise _already(effect, where or taken[0])
    offered = [(c, s) for c, s in offered if where in ("", c.where)]
    possible = best_by_key(fit_, offered)
    if not possible:
        candidate, score = max(offered, key=lambda o: o[1].gain)
        value = physical(fit_, candidate, score.value)
        searched = ", ".join(candidate.shape_names)
        raise RefusedError(
            f"{effect} at {candidate.where} would have {candidate.parameter} {value:.3g} "
            f"{fit_.declared.unit_here(candidate.unit)}, which is physically impossible"
            + (f", wherever the search for {searched} begins" if searched else ""),
            "something else is missing: `rtid diagnose` names it"
            + (", or more values to begin from" if searched else ""),
        )
    trials = []
    for key, (candidate, score) in possible.items():
        revision = replace(fit_.revision, effects=(*fit_.revision.effects, candidate))
        trials.append(Trial(key, score.gain, revision))
    return refined(present.state, fit_, trials)


def _refuse_place(effect: str, where: str, places: list[str]) -> None:
    if where and where not in places:
        raise RefusedError(
            f"{effect} does not act at {where!r} of this machine", nearest(where, places)
        )


def _already(effect: str, where: str) -> RefusedError:
    return RefusedError(
        f"{effect} at {where} is part of the model already", f"`rtid drop {effect}` takes it out"
    )


def _against(before: Standing, after: Standing, trial: Trial) -> Iterator[str]:
    """What speaks against an effect, with figures: over the held-out rows that both fits judge.

    A lag moves the points to other blocks, of which some are known by one fit alone.
    """
    last, now = before.held_out, after.held_out
    old, new = last.at_rows_of(now), now.at_rows_of(last)
    without, having = (100 * residual.rms_m3s / new.flow_m3s for residual in (old, new))
    figures = f"held-out error {without:.2f} % without it, {having:.2f} % with it"
    if not np.isfinite(new.rms_m3s + old.rms_m3s):
        yield UNJUDGED
        return
    share = own_share(after.state, after.fit, trial, now)
    is_slight = min(share, material_share(old, new)) < MATERIAL
    if is_slight and taken_in(before.fit, after.fit, trial, share, last, now):
        pass  # the maps hide it
    elif new.rms_m3s >= old.rms_m3s:
        yield f"it does not lower the held-out error: {figures}"
    elif material_share(old, new) < MATERIAL:
        yield f"it changes next to nothing: {figures}"
    elif share < MATERIAL:
        yield f"its own flow on the held-out part is {100 * share:.2g} % of the rms flow: {figures}"
    if trial.gain <= GAIN:
        yield f"it is not significant: chi2 falls by {max(0.0, trial.gain):.1f}, {GAIN:.0f} needed"
    rest = before.fit.held.sse - before.fit.regression.dof
    if before.fit.rho > MATCH_RHO and trial.gain < LEAST_SHARE * rest:
        yield (
            f"it explains {100 * max(0.0, trial.gain) / rest:.2g} % of the misfit: "
            f"something else is missing first ({figures})"
        )


def _better(present: Standing, trial: Trial) -> str:
    """The fixed column that chi2 would fall by clearly more with."""
    best = best_by_key(present.fit, scored(present.fit))
    gains = {key: score.gain for key, (_, score) in best.items() if key[1] != COMMAND}
    key = max(gains, key=lambda k: gains[k], default=trial.key)
    if key == trial.key or gains[key] <= trial.gain * (1 + TIE_SHARE) + TIE:
        return ""
    return (
        f"{key[0]} at {key[1]} would explain {gains[key] / max(trial.gain, 1.0):.1f} times as much"
    )
