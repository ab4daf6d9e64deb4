"""The plain values of a search, and what to do next: a `Diagnosis` of its `Result`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.diagnose.clean import cuts
from rtid.diagnose.consequence import Consequence
from rtid.diagnose.diagnosis import Result
from rtid.diagnose.excuse import counted, steady
from rtid.diagnose.experiment import SWING, foretold, would_separate
from rtid.diagnose.fit import Fit
from rtid.diagnose.fitted_sizes import parameters
from rtid.diagnose.lag_interval import LagInterval, is_at_most, known_lag
from rtid.diagnose.nameable import clearest, known_as_moduli
from rtid.diagnose.regression import Score
from rtid.diagnose.remains import described
from rtid.diagnose.report import (
    Diagnosis,
    FittedEffect,
    FoundEffect,
    HiddenInMap,
    Small,
    Unseen,
    Value,
)
from rtid.diagnose.softer import Softer
from rtid.diagnose.trials import AcceptedEffect, detection_limit
from rtid.diagnose.unseen import has_size, in_its_unit, is_unexplained, not_found
from rtid.diagnose.verdict import CLEARLY_LEFT, INSUFFICIENT, UNKNOWN, filtered_hz
from rtid.diagnose.zeros import Zero, by_chance
from rtid.effects import catalogue
from rtid.effects.column import Candidate
from rtid.effects.law import chambers_by_place
from rtid.effects.laws.pump import FLOW, PUMP, delivered, demand
from rtid.effects.laws.timing import COMMAND, RATES
from rtid.effects.page import ZERO, correcting
from rtid.plain import FloatArray, Key
from rtid.units import limit

LONG_STEP = 0.2  # share of the delay: a shorter step changes little
TOGETHER = "delay and lag together are"
CALLED = {"delay": "the delay is", "time_constant": "the lag is"}
WORTH = 2.0  # times better that an experiment must be to be proposed


def diagnosis(result: Result) -> Diagnosis:
    """The plain values of a search."""
    sizeless = tuple(f.key for f in result.found[1:] if not has_size(result.last, f.key))
    result = replace(result, found=tuple(f for f in result.found if f.key not in sizeless))
    last, effects = result.last, tuple(_effect(result, f) for f in result.found)
    if result.verdict != UNKNOWN:  # what explains a part of it only is not named
        effects += tuple(_shown_too_much(result, z) for z in result.zeros if z.matters)
        effects += (_stored(result, result.softer),) if result.softer else ()
    words = steady(last)
    late = _late(result, words)
    unseen = not_found(result, sizeless)
    cut_hz = _cut_hz(result)
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
        beta_pa=moduli(words.compliance),
        lag_s=words.weights.lag_s,
        lag_sd_s=_sd_of_lag(words, late),
        something_remains=last.rho >= last.most_rho or result.verdict == UNKNOWN,
        held_out_judged=result.held_out_judged,
        not_found=unseen,
        negligible=tuple(
            Small(effect, where, share) for (effect, where), share in result.negligible.items()
        ),
        advice=advice(result, unseen, cut_hz),
        doubts=result.doubts,
        cut=cuts(last.declared, last.chunk),
        disturbance=max(chamber.disturbance for chamber in last.declared.chambers),
        zeros=result.zeros,
        beta_sd_pa=_sd_of_moduli(words, late, unseen),
        filtered_hz=cut_hz,
        map_sd_m3s=result.after.map_sd_m3s,
    )


def moduli(compliance: FloatArray) -> tuple[float, ...]:
    """Bulk moduli, Pa, of compliances (chambers,), 1/Pa; infinite where none is seen.

    What is missing may make one less than none: -5.8 and -9.9 GPa were told beside an `unknown`.
    """
    return tuple(1.0 / float(c) if c > 0.0 else float("inf") for c in compliance)


def _late(result: Result, fit: Fit) -> LagInterval | None:
    """How well the spools' lag is known; None where what is missing bends it, and the moduli.

    Beside a line that nobody named they were 1.8 and 1.9 GPa, of 1.3: by the noise to 0.02.  And
    beside a relief valve that was, 1.06 GPa to 0.002, of 1.38: hoses were left.
    """
    if is_unexplained(result) or fit.rho >= CLEARLY_LEFT:
        return None
    return known_lag(fit)


def _sd_of_lag(fit: Fit, late: LagInterval | None) -> float:
    """Standard deviation of the spools' lag, s; NaN where what is missing bends it.

    So it is where the lag stands at the most that it may be: there it stands in for something.
    Beside a sag that was too small to matter 6.016 +- 0.13 ms were told, its bound, of 3.76.
    """
    return float("nan") if late is None or is_at_most(fit) else late.sd_s


def _sd_of_moduli(
    fit: Fit, late: LagInterval | None, unseen: tuple[Unseen, ...]
) -> tuple[float, ...]:
    """Standard deviations of the bulk moduli, Pa; NaN where what is missing bends them.

    What was seen and is not named may be in them: hoses that nothing confirmed, which moved 835 MPa
    to 535 +- 6.
    """
    if late is None:
        return (float("nan"),) * len(fit.compliance)
    sd = np.hypot(np.sqrt(np.maximum(np.diag(counted(fit)), 0.0)), late.compliance)
    places, more = chambers_by_place(fit.declared), np.zeros(len(sd))
    for cause in unseen:
        at = list(places.get(cause.where, ()))
        more[at] = np.maximum(more[at], cause.moves_beta or 0.0)
    sd = np.hypot(sd, more * fit.compliance)
    return tuple(
        float(s / c**2) if c > 0.0 else float("nan")
        for s, c in zip(sd, fit.compliance, strict=True)
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
    return HiddenInMap(own, dict(does.maps), dict(does.beta), tuple(separates), does.lag_s)


def _named(result: Result, best: Key, other: Key) -> str:
    """The name alone, with its place where that differs."""
    return other[0] if other[1] == best[1] else f"{other[0]} ({other[1]})"


def advice(result: Result, unseen: tuple[Unseen, ...], cut_hz: float = 0.0) -> tuple[str, ...]:
    """What an unknown residual follows; which motion would tell more of what is open.

    cut_hz: of the filter behind which the pressures were logged, Hz.
    """
    pages = catalogue()
    lines = [_of_a_filter(cut_hz)] if cut_hz else []
    lines += described(result.last) if result.verdict == UNKNOWN else []
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


def _cut_hz(result: Result) -> float:
    """Cut-off of the logger's filter, Hz, where more than noise is left and has no name; else 0."""
    is_open = result.verdict in (UNKNOWN, INSUFFICIENT) and result.last.rho >= result.last.most_rho
    return filtered_hz(result.last) if is_open else 0.0


def _of_a_filter(cut_hz: float) -> str:
    return (
        f"The pressures were filtered, at about {cut_hz:.2g} Hz, which delays and rounds off what "
        "is quick: it may be what is left. Log them unfiltered to have the rest judged."
    )


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
    fit = result.last
    both = foretold(fit, closed) if closed else {}
    here, varied = (
        dict(known_as_moduli(fit, [(c, s[k]) for c, s in both.items()])) for k in range(2)
    )
    before, after = clearest([*here.items()]), clearest([*varied.items()])
    lines = list[str]()
    for key, (candidate, score) in after.items():
        # the column of a timing or a line is of one strength, and each record tells another one;
        # all else is compared in one form
        is_strong = candidate.where == COMMAND or candidate.is_whole
        own = before[key] if is_strong else (candidate, here[candidate])
        lines += _would_be_seen(fit, own, (candidate, score))
    return lines


def _would_be_seen(
    fit: Fit, here: tuple[Candidate, Score], varied: tuple[Candidate, Score]
) -> list[str]:
    """The sizes of a cause that this record and a varied supply tell, if that is worth it.

    Of two lines "0.042" and "0.0012" were told, of 8.9 and 0.4 MPa s2/m3: shares of their columns.
    """
    (now, _, is_now), (then, unit, is_possible) = (
        in_its_unit(fit, candidate, detection_limit(score, fit.rho))
        for candidate, score in (here, varied)
    )
    is_rate = varied[0].parameter == "share" and varied[0].shape_units[0] in RATES
    less, more = (now, then) if is_rate else (then, now)  # a fast spool is the smaller lag
    if not (is_possible and 0.0 < then < np.inf) or (is_now and more <= WORTH * less):
        return []
    effect, where = varied[0].key
    instead = limit(now, unit) if is_now and np.isfinite(now) else "at no possible size"
    return [
        f"Supply varied by {100 * SWING:.0f} % in the same motion: {effect} ({where}) would be "
        f"seen from {limit(then, unit)} {'down' if is_rate else 'on'}, instead of {instead}."
    ]
