"""A diagnosis in plain values: what is missing, how large, how sure, what could not be seen.

`Diagnosis.as_json` follows the schema that `schema.md` describes.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from rtid.diagnose.candidates import Candidate
from rtid.diagnose.diagnosis import Result
from rtid.diagnose.experiment import limits
from rtid.diagnose.fit import Fit
from rtid.diagnose.regression import Score
from rtid.diagnose.trials import Found, Key, detection_limit, physical
from rtid.diagnose.verdict import INSUFFICIENT, UNKNOWN
from rtid.effects import catalogue

SCHEMA = 1
WORTH = 2.0  # times better that an experiment must be to be proposed
SILENT = (UNKNOWN, INSUFFICIENT)  # verdicts that say nothing of what remains
VISIBLE = 2e-3  # share of a column that must be left beside the maps
HYDRAULIC = ("flow", "storage", "timing", "supply", "map")


@dataclass(frozen=True)
class Value:
    """One parameter of an effect: SI."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class Effect:
    """An effect that was found, in the order of addition."""

    effect: str
    where: str
    cannot_be_told_from: tuple[str, ...]
    parameters: dict[str, Value]
    p_value: float
    heldout_gain_pct: float
    heldout_residual_before_m3s: float
    heldout_residual_after_m3s: float


@dataclass(frozen=True)
class Added:
    """An effect that the project has added, as fitted to this record."""

    effect: str
    where: str
    parameters: dict[str, Value]


@dataclass(frozen=True)
class Unseen:
    """An effect that was not found: the smallest size that the record would have shown."""

    effect: str
    where: str
    detection_limit: float | None
    unit: str
    visible: bool
    reason: str


@dataclass(frozen=True)
class Small:
    """An effect that is significant and changes next to nothing."""

    effect: str
    where: str
    heldout_share_of_rms_flow: float


@dataclass(frozen=True)
class Diagnosis:
    """Everything that `rtid diagnose` says; residuals are root mean squares behind H_f."""

    verdict: str
    added: tuple[Added, ...]
    found: tuple[Effect, ...]
    rho_before: float
    rho_after: float
    heldout_residual_before_m3s: float
    heldout_residual_after_m3s: float
    noise_floor_m3s: float
    rms_flow_m3s: float
    beta_pa: tuple[float, ...]
    lag_s: float
    something_remains: bool
    held_out_judged: bool
    not_found: tuple[Unseen, ...]
    negligible: tuple[Small, ...]
    advice: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain JSON types; numbers that are not finite are null."""
        return {"schema": SCHEMA} | _plain(asdict(self))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def diagnosis(result: Result) -> Diagnosis:
    """The plain values of a search."""
    last, found = result.last, tuple(_effect(result, f) for f in result.found)
    unseen = _not_found(result)
    return Diagnosis(
        verdict=result.verdict,
        added=tuple(Added(*p.key, parameters(last, p.key)) for p in result.given),
        found=found,
        rho_before=result.first.rho,
        rho_after=last.rho,
        heldout_residual_before_m3s=result.before.rms_m3s,
        heldout_residual_after_m3s=result.after.rms_m3s,
        noise_floor_m3s=result.after.floor_m3s,
        rms_flow_m3s=result.after.flow_m3s,
        beta_pa=tuple(1.0 / float(c) if c else float("inf") for c in last.compliance),
        lag_s=last.weights.lag_s,
        something_remains=result.verdict not in SILENT and last.rho > result.match_rho,
        held_out_judged=result.held_out_judged,
        not_found=unseen,
        negligible=tuple(
            Small(effect, where, share) for (effect, where), share in result.negligible.items()
        ),
        advice=advice(result, unseen),
    )


def _effect(result: Result, found: Found) -> Effect:
    before, after = found.before.rms_m3s, found.after.rms_m3s
    tests = max(1, len(result.scores) + len(result.last.revision.effects))
    return Effect(
        effect=found.key[0],
        where=found.key[1],
        cannot_be_told_from=tuple(_named(result, found.key, key) for key in found.alike),
        parameters=parameters(result.last, found.key),
        p_value=float(min(1.0, tests * chi2.sf(found.gain, found.n_parameters))),
        heldout_gain_pct=100.0 * (1.0 - after / before),
        heldout_residual_before_m3s=before,
        heldout_residual_after_m3s=after,
    )


def _named(result: Result, best: Key, other: Key) -> str:
    """The name alone, with its place where that differs."""
    return other[0] if other[1] == best[1] else f"{other[0]} ({other[1]})"


def parameters(fit: Fit, key: Key) -> dict[str, Value]:
    """The parameters of a cause that is part of a fit, by name."""
    found: dict[str, Value] = {}
    spread = np.sqrt(max(1.0, fit.rho))
    for k, (timing, psi) in enumerate(fit.revision.timings):
        if timing.effect == key[0]:
            for name, unit, value, j in zip(
                timing.parameters, timing.units, psi, fit.timing_columns(k), strict=True
            ):
                found[name] = Value(value, fit.estimate.sd(j) * spread, unit)
    for effect in fit.revision.effects:
        if effect.key == key:
            column = fit.column(effect)
            value, sd = fit.held.value(column), fit.estimate.sd(column) * spread
            scale = physical(fit, effect, 1.0)
            found[effect.parameter] = Value(scale * value, scale * sd, effect.unit)
            free = fit.shape_columns(effect)
            for k, name in enumerate(effect.shape_names):
                sd = fit.estimate.sd(free[k]) * spread / abs(value) if k in free else float("nan")
                found[name] = Value(effect.shape[k], sd, effect.shape_units[k])
    return found


def _not_found(result: Result) -> tuple[Unseen, ...]:
    """Every effect of the catalogue that concerns this machine and was not added."""
    best: dict[Key, tuple[Candidate, Score]] = {}
    for candidate, score in result.scores:
        known = best.get(candidate.key)
        if known is None or score.sd < known[1].sd:
            best[candidate.key] = candidate, score
    own = {f.key for f in result.found} | {p.key for p in result.given}
    seen = [
        _limit(result, candidate, score)
        for key, (candidate, score) in best.items()
        if key not in own
    ]
    named = {u.effect for u in seen} | {key[0] for key in own}
    absent = [
        Unseen(name, "", None, "", False, page.visible_when or page.summary)
        for name, page in catalogue().items()
        if page.kind in HYDRAULIC and name not in named
    ]
    return tuple(seen + absent)


def _limit(result: Result, candidate: Candidate, score: Score) -> Unseen:
    fit, unit = result.last, candidate.unit
    limit = physical(fit, candidate, detection_limit(score, fit.rho))
    if candidate.parameter == "share":  # of a timing: times the value that its column was made for
        limit, unit = _of_timing(candidate, limit), candidate.shape_units[0]
        visible = np.isfinite(limit) and score.visible > VISIBLE
    else:
        visible = score.visible > VISIBLE and limit < candidate.largest
    if candidate.key in result.negligible:
        reason = "present, negligible: it changes next to nothing on the held-out part"
    elif visible:
        reason = ""
    else:
        reason = f"the maps follow {100 * (1 - score.visible**2):.2f} % of it in this record"
    return Unseen(candidate.effect, candidate.where, float(limit), unit, bool(visible), reason)


def _of_timing(candidate: Candidate, share: float) -> float:
    """Share of a timing as its parameter: a spool is the slower the lower its frequency."""
    (shape,), (name,) = candidate.shape, candidate.shape_names
    return shape / share if name == "natural_frequency" else shape * share


def advice(result: Result, unseen: tuple[Unseen, ...]) -> tuple[str, ...]:
    """Which motion would tell more: from the catalogue, for what is open in this record."""
    pages, found = catalogue(), []
    for f in result.found:
        for key in f.alike:
            page = pages.get(f.key[0])
            if page is not None and key[0] in page.confounders:
                found.append(f"To tell {f.key[0]} from {key[0]}: {page.separates}")
    hidden = sorted({u.effect for u in unseen if not u.visible and u.detection_limit is not None})
    for name in hidden:
        page = pages.get(name)
        if page is not None and page.visible_when:
            found.append(f"{name} cannot be seen in this record: {page.visible_when}")
    return tuple(dict.fromkeys(found + _experiment(result, unseen)))


def _experiment(result: Result, unseen: tuple[Unseen, ...]) -> list[str]:
    """What a wandering supply would show, computed from this record's own motion."""
    closed = {(u.effect, u.where) for u in unseen if not u.visible}
    closed |= {key for f in result.found for key in (f.key, *f.alike) if f.alike}
    best: dict[Key, tuple[float, float]] = {}
    for candidate, (before, after) in (limits(result.last) if closed else {}).items():
        if candidate.key in closed and np.isfinite(after) and after > 0:
            scale = physical(result.last, candidate, 1.0)
            known = best.get(candidate.key)
            if known is None or scale * after < known[1]:
                best[candidate.key] = scale * before, scale * after
    units = {c.key: "" if c.unit == "1" else f" {c.unit}" for c, _ in result.scores}
    return [
        f"Supply varied by 20 % in the same motion: {effect} ({where}) would be seen from "
        f"{after:.2g}{units.get((effect, where), '')} on, instead of {before:.2g}."
        for (effect, where), (before, after) in best.items()
        if before > WORTH * after
    ]
