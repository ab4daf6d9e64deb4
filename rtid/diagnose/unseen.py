"""What was not found, with the size from which on the record would have shown it.

By derivatives: a candidate of four deviations, and no less than what is seen and nothing confirms.
"""

from __future__ import annotations

import numpy as np

from rtid.diagnose.diagnosis import Result
from rtid.diagnose.exact import LARGE
from rtid.diagnose.fit import Fit
from rtid.diagnose.fitted_sizes import over, parameters
from rtid.diagnose.halves import in_its_form
from rtid.diagnose.nameable import NOTHING, VISIBLE, clearest, told_form
from rtid.diagnose.regression import LIMIT_SD, Score
from rtid.diagnose.report import (
    LOOKS_LIKE,
    MISLED,
    NO_SIZE,
    NOBODY_LOOKED,
    NOISE_ALONE,
    NOT_CONFIRMED,
    Unseen,
    Value,
)
from rtid.diagnose.sized import physical
from rtid.diagnose.trials import detection_limit
from rtid.diagnose.verdict import INSUFFICIENT, UNKNOWN
from rtid.diagnose.zeros import Zero
from rtid.effects import catalogue
from rtid.effects.column import Candidate
from rtid.effects.law import is_of_rates
from rtid.effects.laws.lines import inertance
from rtid.effects.laws.timing import (
    COMMAND,
    COMMAND_RATE,
    OF_COMMAND,
    RATES,
    command_times,
    outrun_rates,
)
from rtid.effects.page import ZERO, correcting
from rtid.plain import Key
from rtid.units import Z95

HYDRAULIC = ("flow", "storage", "timing", "supply", "map")


def has_size(fit: Fit, key: Key) -> bool:
    """False where the 95 % interval of an effect's size holds zero.

    A leak of 1.5e-12 +- 5.0e-12 was named beside a worn place whose form was wrong: it took a part
    of the misfit, and trades with the other.  One that only trades with a number of its own form is
    a size all the same: with air of another exponent it is another share, and none is nothing.
    """
    size = next(iter(parameters(fit, key).values()))
    return not abs(size.value) < Z95 * size.std * _of_its_form(fit, key)


def _of_its_form(fit: Fit, key: Key) -> float:
    """Deviation of an effect's size, its form being what it is, as a share of that beside it."""
    own = [e for e in fit.revision.effects if e.key == key and not e.is_whole]
    if not own:
        return 1.0
    column = fit.column(own[0])
    sd, more = in_its_form(fit, own[0]).sd(column), dict(fit.spreads).get(column, 0.0)
    by_form = float(np.hypot(sd * np.sqrt(max(1.0, fit.rho)), more))
    return by_form / max(fit.sd_of(column), NOTHING)


def _without_size(fit: Fit, key: Key) -> Unseen:
    size = next(iter(parameters(fit, key).values()))
    return Unseen(*key, LIMIT_SD * size.std, size.unit, True, NO_SIZE)


def not_found(result: Result, sizeless: tuple[Key, ...]) -> tuple[Unseen, ...]:
    """Every effect of the catalogue that concerns this machine and was not found.

    sizeless: what was added to the model, and has no size that is told.
    """
    best = clearest(result.scores)
    listed = {f.key for f in result.found} | {p.key for p in result.given}
    listed |= {*sizeless, *(result.softer.causes if result.softer else ())}
    seen = [
        _limit(result, candidate, score)
        for key, (candidate, score) in best.items()
        if key not in listed
    ]
    seen += [_without_size(result.last, key) for key in sizeless]
    seen += [_told_by_joints(zero) for zero in result.zeros if not zero.matters]
    named = {u.effect for u in seen} | {key[0] for key in listed}
    has_pressures = result.last.declared.has_pressures
    absent = [
        Unseen(name, "", None, "", False, f"{NOBODY_LOOKED} {page.visible_when}", examined=False)
        for name, page in (dict(catalogue()) | {s.name: s for s in result.last.suspects}).items()
        if page.kind in HYDRAULIC
        and name not in named
        and not (has_pressures and is_of_rates(page))
    ]
    return tuple(seen + absent)


def _limit(result: Result, candidate: Candidate, score: Score) -> Unseen:
    if _is_misled(result):
        return Unseen(*candidate.key, None, "", True, MISLED)
    by, known = result.reach.get(candidate.key, (candidate, None))
    doubtful = known.not_believed(score) if known and by == candidate else 0.0
    doubtful = doubtful or _looks_like(result, score)
    least = max(detection_limit(score, result.last.rho), doubtful)
    limit, unit, is_possible = in_its_unit(result.last, candidate, least)
    visible = score.visible > VISIBLE and is_possible
    from_ = max(known.named_from, doubtful) if known else np.inf
    named_from, _, may_be = in_its_unit(result.last, by, from_)
    if doubtful:
        reason = LOOKS_LIKE if is_unexplained(result) else NOT_CONFIRMED
    elif candidate.key in result.negligible:
        reason = "present, negligible: it changes next to nothing on the held-out part"
    elif visible:
        reason = ""
    elif np.isinf(score.sd) and score.visible > 0.0:
        reason = NOISE_ALONE
    elif score.visible > VISIBLE:
        reason = "only a size beyond all that is possible would have shown"
    else:
        reason = f"the maps follow {100 * (1 - score.visible**2):.2f} % of it in this record"
    taken = _taken_for_lag(result.last, candidate, unit)
    largest = max(float(limit), taken) if is_possible else None
    named = max(float(named_from), taken) if may_be and known else None
    key = candidate.effect, candidate.where
    at = _form(candidate) | over(result.last, candidate)
    is_seen = known is not None and (bool(doubtful) or candidate.key in result.negligible)
    moves = known.beyond_interval(score.value) if known and is_seen and by == candidate else None
    said = *key, largest, unit, bool(visible), reason, True, named, at
    return Unseen(*said, _seen(result.last, candidate, score) if doubtful else None, moves)


def _seen(fit: Fit, candidate: Candidate, score: Score) -> Value:
    """The size that the record shows of a cause, with its deviation by the misfit that is left."""
    deviation = score.sd * float(np.sqrt(max(1.0, fit.rho)))
    (size, unit, _), (sd, _, _) = (
        in_its_unit(fit, candidate, c) for c in (abs(score.value), deviation)
    )
    return Value(float(size), float(sd), unit)


def _is_misled(result: Result) -> bool:
    """Whether limits by derivatives are untrue: what is missing has bent the maps of all columns.

    A sag a thousand times its limit stood beside it; two relief valves of 5.2e-11 m3/(s Pa) beside
    2.3e-12 and 1.1e-12, where each makes up for a part of the other.
    """
    return is_unexplained(result) and result.last.rho >= LARGE


def is_unexplained(result: Result) -> bool:
    """Whether what is left of the record is more than noise, and has no name."""
    is_left = result.last.rho >= result.last.most_rho
    return result.verdict == UNKNOWN or (result.verdict == INSUFFICIENT and is_left)


def _looks_like(result: Result, score: Score) -> float:
    """The upper end of the size that a record shows of a cause, where what is missing is unknown.

    A part of what is missing may be this: less than the record shows of it is not excluded.
    """
    sd = score.sd * float(np.sqrt(max(1.0, result.last.rho)))
    is_shown = is_unexplained(result) and abs(score.value) > LIMIT_SD * sd
    return abs(score.value) + Z95 * sd if is_shown else 0.0


def _taken_for_lag(fit: Fit, candidate: Candidate, unit: str) -> float:
    """What of a time behind the command the lag of the spools has taken in, s, where it is free.

    Derivatives beside the lag that was found say little of it: of 6 ms of delay and 1.1 of lag, on
    a sweep 7.05 of lag, they promised 345 of chi2, where 76 are to be had.
    """
    if candidate.where != COMMAND or unit != "s" or fit.lag_tolerance_s == 0.0:
        return 0.0
    return abs(fit.weights.lag_s - fit.declared.lag.nominal_s)


def _form(candidate: Candidate) -> dict[str, Value]:
    """Where and how what a column is of acts, as far as that has a unit: sizes of others differ.

    A make-up valve that opens at 4.9 MPa is seen from a fiftieth of one that opens at 1.6 MPa on.
    A timing's column is as strong as its own number says, and a line's size is made of its shape.
    """
    if candidate.where == COMMAND or candidate.is_whole:
        return {}
    return {n: Value(v, float("nan"), unit) for n, v, unit in told_form(candidate) if v != 0.0}


def in_its_unit(fit: Fit, candidate: Candidate, coefficient: float) -> tuple[float, str, bool]:
    """A coefficient as the size that people know, its unit, and whether it is possible.

    That of a timing is times the value that its column was made for.
    """
    size, unit = physical(fit, candidate, coefficient), candidate.unit
    if candidate.is_whole:
        size, unit = size * inertance(fit.view, candidate), candidate.law.size.unit
        return size, unit, size < candidate.law.size.high
    if candidate.parameter == "share":
        size, (unit,) = _of_timing(candidate, size), candidate.shape_units
        if unit == COMMAND_RATE:  # what no command outruns does nothing
            size = min(size, max(outrun_rates(fit.declared, fit.chunk), default=np.inf))
        pages = catalogue()[candidate.effect].parameters
        (page,) = [p for p in pages if p.name in candidate.shape_names]
        times = command_times(fit.declared) if page.unit in OF_COMMAND else 1.0
        is_possible = times * page.low < size if page.unit in RATES else size < times * page.high
        return size, fit.declared.unit_here(unit), is_possible
    return size, fit.declared.unit_here(unit), size < candidate.largest


def _told_by_joints(zero: Zero) -> Unseen:
    """The smallest error of a sensor's zero that its joints would have shown."""
    (page,) = correcting(ZERO)
    return Unseen(page.name, zero.signal, LIMIT_SD * zero.std_pa, page.size.unit, True, "")


def _of_timing(candidate: Candidate, share: float) -> float:
    """Share of a timing as its parameter: a spool is the slower the lower its frequency."""
    (shape,), (unit,) = candidate.shape, candidate.shape_units
    return shape / share if unit in RATES else shape * share
