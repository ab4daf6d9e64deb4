"""A diagnosis in plain values: what is missing, how large, how sure, what could not be seen.

`Diagnosis.as_json` follows the schema that `schema.md` describes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from rtid.diagnose.clean import Cut, cuts
from rtid.diagnose.consequence import Consequence
from rtid.diagnose.diagnosis import Result
from rtid.diagnose.exact import LARGE, is_refitted
from rtid.diagnose.excuse import steady
from rtid.diagnose.experiment import limits, would_separate
from rtid.diagnose.fit import Fit
from rtid.diagnose.nameable import VISIBLE, clearest
from rtid.diagnose.regression import LIMIT_SD, Score
from rtid.diagnose.remains import described
from rtid.diagnose.softer import Softer
from rtid.diagnose.trials import AcceptedEffect, detection_limit, physical
from rtid.diagnose.verdict import MATERIAL, UNKNOWN
from rtid.diagnose.zeros import Zero, by_chance
from rtid.effects import catalogue
from rtid.effects.column import Candidate
from rtid.effects.law import LENGTH, fitted_names, is_of_rates
from rtid.effects.laws.lines import LINE, inertance
from rtid.effects.laws.pump import FLOW, PUMP, delivered, demand
from rtid.effects.laws.timing import COMMAND, OF_COMMAND, RATE, command_times
from rtid.effects.page import ZERO, correcting
from rtid.estimator.validity import Doubt
from rtid.plain import Key, plain
from rtid.units import Z95, limit

SCHEMA = 1
LONG_STEP = 0.2  # share of the delay: a shorter step changes little
TOGETHER = "delay and lag together are"
CALLED = {"delay": "the delay is", "time_constant": "the lag is"}
WORTH = 2.0  # times better that an experiment must be to be proposed
NOBODY_LOOKED = "Not examined: the diagnosis has no column for it here."
MISLED = "not told: what else is missing bends the maps that would tell it"
NOT_CONFIRMED = "not confirmed: what the maps' blocks miss may look like it in this record"
NO_SIZE = "not confirmed: the 95 % interval of its size, beside what was found, holds zero"
HYDRAULIC = ("flow", "storage", "timing", "supply", "map")
OVER = "over"  # beside a change: the time in which it is so large


@dataclass(frozen=True)
class Value:
    """One parameter of an effect: SI."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class HiddenInMap:
    """What leaving an effect out bends where the residual hardly shows it: shares, 1.

    own_flow: of the rms flow, None for a timing; maps: root mean square over the visits, of an
    edge's largest flow; beta: relative, of the chambers whose modulus leaves its interval;
    separates: what would keep it out of the maps.
    """

    own_flow: float | None
    maps: dict[str, float]
    beta: dict[str, float]
    separates: tuple[str, ...]


@dataclass(frozen=True)
class FoundEffect:
    """An effect that was found, in the order of addition.

    hidden_in_map: None where the residual shows it; not_reached: what parameters are above that
    the record never came to, as a pump's flow.
    """

    effect: str
    where: str
    cannot_be_told_from: tuple[str, ...]
    parameters: dict[str, Value]
    p_value: float
    heldout_gain_pct: float
    heldout_residual_before_m3s: float
    heldout_residual_after_m3s: float
    hidden_in_map: HiddenInMap | None = None
    not_reached: Mapping[str, Value] = field(default_factory=dict)

    @property
    def alike(self) -> tuple[Key, ...]:
        """Name and place of what it cannot be told from."""
        parts = [text.partition(" (") for text in self.cannot_be_told_from]
        return tuple((name, where.removesuffix(")") or self.where) for name, _, where in parts)


@dataclass(frozen=True)
class FittedEffect:
    """An effect that the project has added, as fitted to this record."""

    effect: str
    where: str
    parameters: dict[str, Value]


@dataclass(frozen=True)
class Unseen:
    """An effect that was not found: the smallest size that the record would have shown.

    detection_limit: of four standard deviations; named_from: the size from which on it would have
    been named, which must also matter; None where no possible one would.
    examined: False where this machine and record have no column for it: nobody looked.
    form: the numbers beside its size that the sizes are of, as the pressure at which a valve opens.
    """

    effect: str
    where: str
    detection_limit: float | None
    unit: str
    visible: bool
    reason: str
    examined: bool = True
    named_from: float | None = None
    form: Mapping[str, Value] = field(default_factory=dict)


@dataclass(frozen=True)
class Small:
    """An effect that is significant and changes next to nothing."""

    effect: str
    where: str
    heldout_share_of_rms_flow: float


@dataclass(frozen=True)
class Diagnosis:
    """Everything that `rtid diagnose` says; residuals are root mean squares behind H_f.

    disturbance: what the rows were weighed for beside the sensors' noise, rate per sqrt(Hz).
    """

    verdict: str
    added: tuple[FittedEffect, ...]
    found: tuple[FoundEffect, ...]
    rho_before: float
    rho_after: float
    heldout_residual_before_m3s: float
    heldout_residual_after_m3s: float
    noise_floor_m3s: float
    rms_flow_m3s: float
    beta_pa: tuple[float, ...]
    lag_s: float
    lag_sd_s: float
    something_remains: bool
    held_out_judged: bool
    not_found: tuple[Unseen, ...]
    negligible: tuple[Small, ...]
    advice: tuple[str, ...]
    doubts: tuple[Doubt, ...] = ()
    cut: tuple[Cut, ...] = ()
    disturbance: float = 0.0
    zeros: tuple[Zero, ...] = ()

    @property
    def is_slight(self) -> bool:
        """True where what is left beyond the sensors' noise is immaterial for the flow."""
        rest = max(0.0, self.heldout_residual_after_m3s**2 - self.noise_floor_m3s**2)
        return float(np.sqrt(rest)) < MATERIAL * self.rms_flow_m3s

    def as_json(self) -> dict[str, Any]:
        """Plain JSON types; numbers that are not finite are null."""
        return {"schema": SCHEMA} | plain(asdict(self))


def diagnosis(result: Result) -> Diagnosis:
    """The plain values of a search."""
    sizeless = tuple(f.key for f in result.found[1:] if not _has_size(result.last, f.key))
    result = replace(result, found=tuple(f for f in result.found if f.key not in sizeless))
    last, effects = result.last, tuple(_effect(result, f) for f in result.found)
    if result.verdict != UNKNOWN:  # what explains a part of it only is not named
        effects += tuple(_shown_too_much(result, z) for z in result.zeros if z.matters)
        effects += (_stored(result, result.softer),) if result.softer else ()
    words = steady(last)
    unseen = _not_found(result, sizeless)
    return Diagnosis(
        verdict=result.verdict,
        added=tuple(FittedEffect(*p.key, parameters(last, p.key)) for p in result.given),
        found=effects,
        rho_before=result.first.rho,
        rho_after=last.rho,
        heldout_residual_before_m3s=result.before.rms_m3s,
        heldout_residual_after_m3s=result.after.rms_m3s,
        noise_floor_m3s=result.after.floor_m3s,
        rms_flow_m3s=result.after.flow_m3s,
        beta_pa=tuple(1.0 / float(c) if c else float("inf") for c in words.compliance),
        lag_s=words.weights.lag_s,
        lag_sd_s=words.lag_sd_s,
        something_remains=last.rho >= last.most_rho or result.verdict == UNKNOWN,
        held_out_judged=result.held_out_judged,
        not_found=unseen,
        negligible=tuple(
            Small(effect, where, share) for (effect, where), share in result.negligible.items()
        ),
        advice=advice(result, unseen),
        doubts=result.doubts,
        cut=cuts(last.declared, last.chunk),
        disturbance=max(chamber.disturbance for chamber in last.declared.chambers),
        zeros=result.zeros,
    )


def _effect(result: Result, accepted: AcceptedEffect) -> FoundEffect:
    before, after = accepted.before.rms_m3s, accepted.after.rms_m3s
    tests = max(1, len(result.scores) + len(result.last.revision.effects))
    sizes, not_reached = _told(result.last, accepted.key)
    return FoundEffect(
        effect=accepted.key[0],
        where=accepted.key[1],
        cannot_be_told_from=tuple(_named(result, accepted.key, key) for key in accepted.alike),
        parameters=sizes,
        p_value=min(1.0, tests * by_chance(accepted.n_parameters, accepted.gain)),
        heldout_gain_pct=100.0 * (1.0 - after / before),
        heldout_residual_before_m3s=before,
        heldout_residual_after_m3s=after,
        hidden_in_map=_hidden(result.last, accepted.key[0], accepted.hidden),
        not_reached=not_reached,
    )


def _told(fit: Fit, key: Key) -> tuple[dict[str, Value], dict[str, Value]]:
    """The parameters of a cause that are known, and what a pump's flow is above, never reached.

    One of 83 L/min that never gave more than 30 was told as 35 +- 180,000.
    """
    sizes = parameters(fit, key)
    known = {name: size for name, size in sizes.items() if not size.std > abs(size.value)}
    if key[0] != PUMP.effect or not known or len(known) == len(sizes):
        return sizes, {}
    (psi,) = (psi for timing, psi in fit.revision.timings if timing.effect == PUMP.effect)
    most = delivered(demand(fit.view), fit.view.step_s, psi)
    beyond = {FLOW: replace(sizes[FLOW], value=most, std=float("nan"))}
    return known, {} if FLOW in known else beyond


def _shown_too_much(result: Result, zero: Zero) -> FoundEffect:
    """A sensor whose zero is off: the maps have taken it in, whatever the residual."""
    (page,) = correcting(ZERO)
    left = result.after.rms_m3s
    return FoundEffect(
        effect=page.name,
        where=zero.signal,
        cannot_be_told_from=(),
        parameters={page.size.name: Value(zero.apart_pa, zero.std_pa, page.size.unit)},
        p_value=by_chance(1, (zero.apart_pa / zero.std_pa) ** 2),
        heldout_gain_pct=0.0,
        heldout_residual_before_m3s=left,
        heldout_residual_after_m3s=left,
        hidden_in_map=HiddenInMap(None, dict(zero.maps), {}, ()),
    )


def _stored(result: Result, soft: Softer) -> FoundEffect:
    """What a chamber stores beyond its oil: its modulus has taken it in, whatever the residual."""
    page, left = catalogue()[soft.causes[0][0]], result.after.rms_m3s
    size = Value(soft.volume_m3, soft.volume_sd_m3, page.size.unit)
    return FoundEffect(
        effect=page.name,
        where=soft.chamber,
        cannot_be_told_from=tuple(name for name, _ in soft.causes[1:]),
        parameters={page.size.name: size},
        p_value=by_chance(1, (soft.share / soft.share_sd) ** 2),
        heldout_gain_pct=0.0,
        heldout_residual_before_m3s=left,
        heldout_residual_after_m3s=left,
        hidden_in_map=HiddenInMap(None, {}, {soft.chamber: soft.share}, ()),
    )


def _hidden(fit: Fit, effect: str, does: Consequence | None) -> HiddenInMap | None:
    if does is None:
        return None
    pages = dict(catalogue()) | {s.name: s for s in fit.suspects}
    own = does.own_share if np.isfinite(does.own_share) else None
    separates = would_separate(fit, pages[effect].kind)
    return HiddenInMap(own, dict(does.maps), dict(does.beta), tuple(separates))


def _named(result: Result, best: Key, other: Key) -> str:
    """The name alone, with its place where that differs."""
    return other[0] if other[1] == best[1] else f"{other[0]} ({other[1]})"


def parameters(fit: Fit, key: Key) -> dict[str, Value]:
    """The parameters of a cause that is part of a fit, by name."""
    values: dict[str, Value] = {}
    here = fit.declared.unit_here
    for k, (timing, psi) in enumerate(fit.revision.timings):
        if timing.is_at(*key):
            for name, unit, value, j in zip(
                timing.parameters, timing.units, psi, fit.timing_columns(k), strict=True
            ):
                values[name] = Value(value, fit.sd_of(j), here(unit))
    for effect in fit.revision.effects:
        if effect.key == key:
            column = fit.column(effect)
            value, sd = fit.held.value(column), fit.sd_of(column)
            scale = physical(fit, effect, 1.0)
            if not effect.is_whole:
                values[effect.parameter] = Value(scale * value, abs(scale) * sd, here(effect.unit))
            free = fit.shape_columns(effect)
            for k, name in enumerate(effect.shape_names):
                sd = fit.sd_of(free[k]) / abs(value) if k in free else float("nan")
                values[name] = Value(effect.shape[k], sd, here(effect.shape_units[k]))
            if effect.law.law == LINE:
                values |= _inertance(fit, effect, values)
            values |= _over(fit, effect)
    return values


def _over(fit: Fit, effect: Candidate) -> dict[str, Value]:
    """The time over which a change is told, that of the record that has taught it."""
    if LENGTH not in fitted_names(effect.law):
        return {}
    t_s = fit.view.t_s
    return {OVER: Value(float(t_s[-1] - t_s[0]), float("nan"), "s")}


def _inertance(fit: Fit, line: Candidate, values: dict[str, Value]) -> dict[str, Value]:
    """The inertance of a line by its shape: 1 / (w^2 V_l / beta)."""
    radps, volume, _ = (values[name] for name in line.shape_names)
    size, page = inertance(fit.view, line), line.law.size
    share = float(np.hypot(2.0 * radps.std / radps.value, volume.std / volume.value))
    return {page.name: Value(size, size * share, page.unit)}


def _has_size(fit: Fit, key: Key) -> bool:
    """False where the 95 % interval of an effect's size holds zero.

    A leak of 1.5e-12 +- 5.0e-12 was named beside a worn place whose form was wrong: it took a part
    of the misfit, and trades with the other.
    """
    size = next(iter(parameters(fit, key).values()))
    return not abs(size.value) < Z95 * size.std


def _without_size(fit: Fit, key: Key) -> Unseen:
    size = next(iter(parameters(fit, key).values()))
    return Unseen(*key, LIMIT_SD * size.std, size.unit, True, NO_SIZE)


def _not_found(result: Result, sizeless: tuple[Key, ...]) -> tuple[Unseen, ...]:
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
    if _is_misled(result, candidate):
        return Unseen(*candidate.key, None, "", True, MISLED)
    by, known = result.reach.get(candidate.key, (candidate, None))
    doubtful = known.not_believed(score) if known and by == candidate else 0.0
    least = max(detection_limit(score, result.last.rho), doubtful)
    limit, unit, is_possible = _sized(result.last, candidate, least)
    visible = score.visible > VISIBLE and is_possible
    from_ = max(known.named_from, doubtful) if known else np.inf
    named_from, _, may_be = _sized(result.last, by, from_)
    if doubtful:
        reason = NOT_CONFIRMED
    elif candidate.key in result.negligible:
        reason = "present, negligible: it changes next to nothing on the held-out part"
    elif visible:
        reason = ""
    elif score.visible > VISIBLE:
        reason = "only a size beyond all that is possible would have shown"
    else:
        reason = f"the maps follow {100 * (1 - score.visible**2):.2f} % of it in this record"
    taken = _taken_for_lag(result.last, candidate, unit)
    largest = max(float(limit), taken) if is_possible else None
    named = max(float(named_from), taken) if may_be and known else None
    key = candidate.effect, candidate.where
    at = _form(candidate) | _over(result.last, candidate)
    return Unseen(*key, largest, unit, bool(visible), reason, named_from=named, form=at)


def _is_misled(result: Result, candidate: Candidate) -> bool:
    """Whether a limit by derivatives is untrue: what is missing has bent the maps of the column.

    A sag a thousand times its limit stood beside it: only refits tell what transforms a command, a
    sensor or the supply, where so much is left.
    """
    is_bent = result.verdict == UNKNOWN and result.last.rho >= LARGE
    return is_bent and is_refitted(result.last, candidate.key)


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
    named = zip(candidate.shape_names, candidate.shape, candidate.shape_units, strict=True)
    return {n: Value(v, float("nan"), unit) for n, v, unit in named if v != 0.0 and unit != "1"}


def _sized(fit: Fit, candidate: Candidate, coefficient: float) -> tuple[float, str, bool]:
    """A coefficient as the size that people know, its unit, and whether it is possible.

    That of a timing is times the value that its column was made for.
    """
    size, unit = physical(fit, candidate, coefficient), candidate.unit
    if candidate.is_whole:
        size, unit = size * inertance(fit.view, candidate), candidate.law.size.unit
        return size, unit, size < candidate.law.size.high
    if candidate.parameter == "share":
        size, (unit,) = _of_timing(candidate, size), candidate.shape_units
        pages = catalogue()[candidate.effect].parameters
        (page,) = [p for p in pages if p.name in candidate.shape_names]
        high = page.high * (command_times(fit.declared) if page.unit == OF_COMMAND else 1.0)
        is_possible = page.low < size if page.unit == RATE else size < high
        return size, fit.declared.unit_here(unit), is_possible
    return size, fit.declared.unit_here(unit), size < candidate.largest


def _told_by_joints(zero: Zero) -> Unseen:
    """The smallest error of a sensor's zero that its joints would have shown."""
    (page,) = correcting(ZERO)
    return Unseen(page.name, zero.signal, LIMIT_SD * zero.std_pa, page.size.unit, True, "")


def _of_timing(candidate: Candidate, share: float) -> float:
    """Share of a timing as its parameter: a spool is the slower the lower its frequency."""
    (shape,), (unit,) = candidate.shape, candidate.shape_units
    return shape / share if unit == RATE else shape * share


def advice(result: Result, unseen: tuple[Unseen, ...]) -> tuple[str, ...]:
    """What an unknown residual follows; which motion would tell more of what is open."""
    pages = catalogue()
    lines = list(described(result.last)) if result.verdict == UNKNOWN else []
    lines += _of_held_commands(result)
    for f in result.found:
        for key in f.alike:
            page = pages.get(f.key[0])
            if page is not None and key[0] in page.confounders:
                lines.append(f"To tell {f.key[0]} from {key[0]}: {page.separates}")
    if result.softer:
        name = result.softer.causes[0][0]
        lines.append(f"Where a drawing bears it out, {result.softer.remedy}.")
        lines.append(f"To tell {name} in chamber {result.softer.chamber}: {pages[name].separates}")
    hidden = sorted({u.effect for u in unseen if not u.visible and u.examined})
    for name in hidden:
        page = pages.get(name)
        if page is not None and page.visible_when:
            lines.append(f"{name} cannot be seen in this record: {page.visible_when}")
    return tuple(dict.fromkeys(lines + _experiment(result, unseen)))


def _of_held_commands(result: Result) -> list[str]:
    """How much longer a delay is where a command may have changed long before its row.

    A lag is to first order a delay as long as it: where they are not told apart, it is their sum,
    and one in front of what integrates is as much too short.
    """
    fit = result.last
    steps = np.diff(fit.chunk[:, 0])
    steps = steps[steps <= fit.model.gates.max_gap_s]
    step_s = float(np.mean(steps**2) / np.mean(steps))  # an event falls into long ones more often
    timings = [(t, psi) for t, psi in fit.revision.timings if t.where == COMMAND]
    known = (("delay",),) if fit.model.has_pressures else (("delay",), ("time_constant",))
    delays = [(t.effect, t.parameters[0], psi[0]) for t, psi in timings if t.parameters in known]
    tied = {f.key[0] for f in result.found if any(where == COMMAND for _, where in f.alike)}
    return [
        f"A row comes each {1e3 * step_s:.0f} ms, and the command may have changed up to that long "
        f"before it: from the command itself {TOGETHER if name in tied else CALLED[kind]} "
        f"{1e3 * delay:.0f} to {1e3 * (delay + step_s):.0f} ms, "
        f"{1e3 * (delay + 0.5 * step_s):.0f} ms on average."
        for name, kind, delay in delays
        if step_s > LONG_STEP * delay
    ]


def _experiment(result: Result, unseen: tuple[Unseen, ...]) -> list[str]:
    """What a wandering supply would show, computed from this record's own motion."""
    closed = {(u.effect, u.where) for u in unseen if not u.visible}
    closed |= {key for f in result.found for key in (f.key, *f.alike) if f.alike}
    closed &= {candidate.key for candidate in result.last.columns.candidates}
    best: dict[Key, tuple[float, float]] = {}
    for candidate, (before, after) in (limits(result.last, closed) if closed else {}).items():
        if np.isfinite(after) and after > 0:
            scale = physical(result.last, candidate, 1.0)
            known = best.get(candidate.key)
            if known is None or scale * after < known[1]:
                best[candidate.key] = scale * before, scale * after
    here = result.last.declared.unit_here
    units = {c.key: here(c.unit) for c, _ in result.scores}
    return [
        f"Supply varied by 20 % in the same motion: {effect} ({where}) would be seen from "
        f"{limit(after, units.get((effect, where), '1'))} on, instead of "
        f"{limit(before, units.get((effect, where), '1'))}."
        for (effect, where), (before, after) in best.items()
        if before > WORTH * after
    ]
