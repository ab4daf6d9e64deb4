"""A diagnosis as an engineer reads it: sentences first, then the tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from rtid.diagnose.clean import Cut
from rtid.diagnose.fit import MATCH_RHO
from rtid.diagnose.regression import LIMIT_SD
from rtid.diagnose.remains import FOLLOWS_NONE
from rtid.diagnose.report import (
    MISLED,
    NO_SIZE,
    NOT_CONFIRMED,
    OVER,
    Diagnosis,
    FoundEffect,
    Unseen,
    Value,
)
from rtid.diagnose.verdict import INSUFFICIENT, MATCHES, MATERIAL, UNKNOWN
from rtid.effects.page import title
from rtid.tell.story import Chart, Story, Table
from rtid.tell.words import VERDICTS, is_floor, named, quantity
from rtid.units import CONVENTION, Z95, limit

SLIGHTLY_CUT = 1e-3  # of a record: less is not worth a sentence
MOST_BENDS = 2  # maps that a sentence names
SHOWN = 14  # rows of the table of what was not found
LIMITS = ("seen from", "named from")  # sizes of what was not found
LIMITS_SAY = (
    f"Seen from: the size that stands out by {LIMIT_SD:g} standard deviations of this record. "
    "Named from: the size that also matters; where that is empty, none is known."
)


def story(diagnosis: Diagnosis, evidence: Sequence[Chart] = ()) -> Story:
    """Everything that a diagnosis says; evidence: a chart for each effect that is named."""
    said = with_convention(sentences(diagnosis))
    return Story("", (*said, _found_table(diagnosis), *evidence, _unseen_table(diagnosis)))


def with_convention(lines: list[str]) -> list[str]:
    """The same lines, and what ± means behind them where one has it."""
    return [*lines, CONVENTION] if any("±" in line for line in lines) else lines


def sentences(diagnosis: Diagnosis) -> list[str]:
    """The verdict in plain words."""
    lines = [*_added(diagnosis), _head(diagnosis)]
    if not diagnosis.held_out_judged:
        lines.append(
            "The machine moves too little in the held-out part, or where the map is not known: the "
            "errors are those of the record that taught the model."
        )
    lines += [_not_judged(cut) for cut in diagnosis.cut if cut.share > SLIGHTLY_CUT]
    lines += [_one(diagnosis, effect) for effect in diagnosis.found]
    lines += _zeros(diagnosis)
    if rest := remains(diagnosis):
        lines.append(rest)
    lines += [*seen_and_not_named(diagnosis), *in_the_moduli(diagnosis)]
    doubts = [f"{doubt.text[0].upper()}{doubt.text[1:]}" for doubt in diagnosis.doubts]
    return lines + doubts + list(diagnosis.advice[:4])


def seen_and_not_named(diagnosis: Diagnosis) -> list[str]:
    """What is significant: too small to matter, or of a size that nothing confirms."""
    doubtful = {
        (u.effect, u.where): f" of {quantity(u.seen)}"
        for u in diagnosis.not_found
        if u.reason == NOT_CONFIRMED and u.seen is not None
    }
    keys = [(s.effect, s.where) for s in diagnosis.negligible]
    small = ", ".join(named(key) for key in keys if key not in doubtful)
    large = ", ".join(named(key) + doubtful[key] for key in keys if key in doubtful)
    how = "Too small to matter, if there at all"
    if diagnosis.verdict == INSUFFICIENT:
        how = "Seen, but too small on this motion to be sized"
    sizeless = [named((u.effect, u.where)) for u in diagnosis.not_found if u.reason == NO_SIZE]
    lines = {
        how: small,
        "Seen, not confirmed, as what the maps miss may look like it": large,
        "Beside what was found, of a size that may as well be zero": ", ".join(sizeless),
    }
    return [f"{words}: {which}." for words, which in lines.items() if which]


def in_the_moduli(diagnosis: Diagnosis) -> list[str]:
    """What the moduli are, where what was seen and is not named moves them beyond their intervals.

    Beside 3 % of air that nothing confirmed, moduli of 1036 and 992 MPa were told, of 1117.
    """
    seen = {(s.effect, s.where) for s in diagnosis.negligible}
    moves = {(u.effect, u.where): u.moves_beta for u in diagnosis.not_found if u.moves_beta}
    others = [f"{named(key)} ({_share(move)})" for key, move in moves.items() if key in seen]
    if not others:
        return []
    return [
        "The moduli are effective ones: what was seen and is not named may be in them, and moves "
        f"them by more than their intervals hold: {_and(others)}."
    ]


def _not_judged(cut: Cut) -> str:
    """What a pressure at an end of its range has cut, and what that may mean."""
    begin, end = max(cut.spans_s, key=lambda span: span[1] - span[0])
    limit = quantity(Value(cut.limit_pa, float("nan"), "Pa"))
    why = (
        "the chamber cavitates, a make-up valve feeds it, or the sensor's range is too short"
        if cut.is_low
        else "a relief valve holds it, or the sensor's range is too short"
    )
    return (
        f"{_share(cut.share)} of the record was not judged: {cut.signal} stood at {limit}, the end "
        f"of its range, the longest from {begin:.2f} to {end:.2f} s: {why}."
    )


def _zeros(diagnosis: Diagnosis) -> list[str]:
    """What the pressure sensors show where a valve joins them at rest, but for what is named."""
    off = [z for z in diagnosis.zeros if z.is_off and not z.matters]
    alike = [z for z in diagnosis.zeros if not z.is_off]
    lines = [
        f"{z.signal} shows {quantity(Value(abs(z.apart_pa), z.std_pa, 'Pa'))} "
        f"{'more' if z.apart_pa > 0 else 'less'} than {z.against} where an open valve joins them "
        f"at rest ({z.seconds:.1f} s): "
        + ("it bends no map by 1 %." if z.is_confirmed else "one of them is off, or is not joined.")
        for z in off
    ]
    if alike:
        most = max(abs(z.apart_pa) + Z95 * z.std_pa for z in alike)
        names = _and(list(dict.fromkeys([*(z.signal for z in alike), alike[0].against])))
        lines.append(
            f"The zeros of {names} agree within {limit(most, 'Pa')}, where open valves join them "
            "at rest."
        )
    return lines


def remains(diagnosis: Diagnosis) -> str:
    """What the model with everything found leaves: the words of terminal, page and report.

    The remainder is judged like that of a model which matches, so that the same residual is
    called the same before an effect is added and after it.
    """
    is_open = diagnosis.verdict in (UNKNOWN, INSUFFICIENT)
    if diagnosis.disturbance > 0 and not (is_open or diagnosis.something_remains):
        return "What remains is taken for what moves the plant beside its command."
    if not diagnosis.something_remains:
        return (
            "" if is_open else "What remains is the sensors' noise: no model could be much better."
        )
    if diagnosis.is_slight:
        return (
            "Something remains beyond the noise, and is immaterial: less than "
            f"{100 * MATERIAL:g} % of the rms flow (residual variance {diagnosis.rho_after:.2f} "
            "times the noise's)."
        )
    if is_open:
        return ""
    return (
        f"Something else remains: residual variance still {diagnosis.rho_after:.2f} times "
        f"the noise's."
    )


def _added(diagnosis: Diagnosis) -> list[str]:
    names = ", ".join(f"{title(a.effect)} at {a.where}" for a in diagnosis.added)
    return [f"The model has {names}, added before."] if names else []


def heading(diagnosis: Diagnosis) -> tuple[str, str]:
    """Of terminal, page and report alike: a kind, for the colour, and the heading itself."""
    if diagnosis.verdict == UNKNOWN and diagnosis.doubts:
        return "bad", "The model cannot be right, and no known effect says why"
    if diagnosis.verdict == UNKNOWN and diagnosis.is_slight:
        share = f"{100 * MATERIAL:g} %"
        return "open", f"The model is right to {share} of the rms flow; more than noise is left"
    return VERDICTS[diagnosis.verdict]


def _head(diagnosis: Diagnosis) -> str:
    share = percent(diagnosis, diagnosis.heldout_residual_before_m3s)
    words = heading(diagnosis)[1]
    if diagnosis.verdict == INSUFFICIENT:
        return f"{words}{_left(diagnosis)}."
    if diagnosis.verdict in (MATCHES, UNKNOWN):
        rho = format(diagnosis.rho_after, ".2f" if diagnosis.verdict == MATCHES else ".3g")
        return (
            f"{words}: held-out error {share} of the rms flow{floored(diagnosis, ', ')}; "
            f"residual variance {rho} times the noise's."
        )
    return (
        f"{words}: residual variance {diagnosis.rho_before:.3g} times the noise's, "
        f"{diagnosis.rho_after:.2f} with what was found."
    )


def _left(diagnosis: Diagnosis) -> str:
    """What speaks against the model where nothing can be named."""
    if not diagnosis.rho_before > MATCH_RHO:
        return "" if diagnosis.foretells else _untaught(diagnosis)
    return (
        f", but the model misses something: residual variance {diagnosis.rho_before:.3g} times "
        "the noise's, most of which the maps may have taken in"
    )


def _untaught(diagnosis: Diagnosis) -> str:
    """Of a model that matches what taught it alone."""
    share = percent(diagnosis, diagnosis.heldout_residual_after_m3s)
    return (
        ": the model follows what taught it, but does not foretell the rest: held-out error "
        f"{share} of the rms flow{floored(diagnosis, ', ')}"
    )


def _one(diagnosis: Diagnosis, effect: FoundEffect) -> str:
    known = [f"{name.replace('_', ' ')} {quantity(v)}" for name, v in effect.parameters.items()]
    known += [
        f"{name.replace('_', ' ')} not reached: above {limit(v.value, v.unit)}"
        for name, v in effect.not_reached.items()
    ]
    sizes = ", ".join(known)
    before = percent(diagnosis, effect.heldout_residual_before_m3s)
    after = percent(diagnosis, effect.heldout_residual_after_m3s)
    does = hidden(effect) or (
        f"Adding it lowers the held-out error from {before} to {after}{floored(diagnosis)}."
    )
    text = f"{title(effect.effect)} at {effect.where}: {sizes}. {does}"
    if effect.cannot_be_told_from:
        others = ", ".join(name.replace("_", " ") for name in effect.cannot_be_told_from)
        text += f" It cannot be told apart from {others} in this record."
    return text


def hidden(effect: FoundEffect) -> str:
    """What an effect bends that the maps have taken in; "" where the residual shows it."""
    if effect.hidden_in_map is None:
        return ""
    does = effect.hidden_in_map
    bends = sorted(does.maps.items(), key=lambda bend: -bend[1])[:MOST_BENDS]
    parts = [f"the map {name} ({_share(bend)} of its largest flow)" for name, bend in bends]
    parts += [f"beta {name} ({_share(abs(move))})" for name, move in does.beta.items()]
    if does.lag_s:
        parts.append(f"the lag of the spools ({1e3 * abs(does.lag_s):.2g} ms)")
    own = f"; its own flow is {_share(does.own_flow)} of the rms flow" if does.own_flow else ""
    off = f"{_and(parts)} {'are' if len(parts) > 1 else 'is'} off"
    text = f"The maps hide it: the error hardly shows it, yet without it {off}{own}."
    return f"{text} To separate it: {_and(list(does.separates))}." if does.separates else text


def _share(share: float) -> str:
    return f"{100 * share:.2g} %"


def _and(parts: list[str]) -> str:
    """A list in words."""
    *first, last = parts
    return f"{', '.join(first)} and {last}" if first else last


def percent(diagnosis: Diagnosis, residual_m3s: float) -> str:
    """A residual as a share of the rms flow, in L/min where nothing has moved."""
    if not diagnosis.rms_flow_m3s > 0.0:
        return quantity(Value(residual_m3s, float("nan"), "m3/s"))
    return f"{100 * residual_m3s / diagnosis.rms_flow_m3s:.2f} %"


def floored(diagnosis: Diagnosis, joined: str = "; ") -> str:
    """What the sensors alone leave; nothing where no noise of a sensor stands apart."""
    if not is_floor(diagnosis.noise_floor_m3s, diagnosis.rms_flow_m3s):
        return ""
    return f"{joined}the sensors' floor is {percent(diagnosis, diagnosis.noise_floor_m3s)}"


def _found_table(diagnosis: Diagnosis) -> Table:
    rows = []
    for effect in diagnosis.found:
        key, chance = (effect.effect, effect.where), f"{effect.p_value:.1g}"
        gain = (f"{effect.heldout_gain_pct:.1f} %", chance)
        for k, (name, value) in enumerate(effect.parameters.items()):
            first, last = (key, gain) if k == 0 else (("", ""), ("", ""))
            rows.append((*first, name, quantity(value), *last))
    heads = ("effect", "where", "parameter", "value", "held-out gain|", "p|")
    return Table("found", heads, rows, keys=2)


def _unseen_table(diagnosis: Diagnosis) -> Table:
    listed = sorted(folded(diagnosis.not_found), key=lambda u: not u.visible)
    rows = [
        (u.effect, u.where, *(limits(u) if u.visible else ("cannot be seen", "")), remark(u))
        for u in listed
        if u.examined
    ]
    heads = ("effect", "where", *LIMITS, "remark~")
    return Table(f"not found. {limits_say(diagnosis)}", heads, rows[: 3 * SHOWN], keys=2)


def folded(unseen: Iterable[Unseen]) -> list[Unseen]:
    """What was not found, all that what is missing has bent in one: 38 rows said the same."""
    told, bent = list[Unseen](), list[Unseen]()
    for u in unseen:
        (bent if u.reason == MISLED else told).append(u)
    if len(bent) > 1:
        bent = [replace(bent[0], effect=f"all {len(bent)} that it was asked for", where="")]
    return told + bent


def limits_say(diagnosis: Diagnosis) -> str:
    """What the sizes of what was not found mean; beside what is unknown they are of less."""
    only = " They hold if nothing else were missing." if diagnosis.verdict == UNKNOWN else ""
    return f"{LIMITS_SAY}{only}"


def limits(unseen: Unseen) -> tuple[str, str]:
    """The sizes below `LIMITS`; nothing where no possible one is."""
    sizes = (unseen.detection_limit, unseen.named_from)
    seen, named = ("" if size is None else limit(size, unseen.unit) for size in sizes)
    return seen, named


def remark(unseen: Unseen) -> str:
    """Why an effect was not found, or what its limits are of where they are of one form alone."""
    form = [f"{name.replace('_', ' ')} {quantity(v)}" for name, v in unseen.form.items()]
    words = ("with " if OVER not in unseen.form else "") + ", ".join(form)
    return unseen.reason or (words if form and unseen.visible else "")


def judged(diagnosis: Diagnosis) -> str:
    """Which part of the record the errors are of."""
    return "held-out error" if diagnosis.held_out_judged else "error on the motion it was taught by"


def _to_record(diagnosis: Diagnosis) -> str:
    """What would let a verdict be given."""
    if diagnosis.filtered_hz:
        return (
            "log the pressures unfiltered: behind the logger's filter of about "
            f"{diagnosis.filtered_hz:.2g} Hz what is quick is delayed and rounded off, which may "
            "be what is left."
        )
    return (
        "record a minute or more in which every valve opens over its range, under changing load "
        "or supply pressure; Why says which motion would tell more."
    )


def said(diagnosis: Diagnosis) -> str:
    """The verdict and the next step."""
    rest = percent(diagnosis, diagnosis.heldout_residual_before_m3s)
    match diagnosis.verdict:
        case "insufficient_data":
            known = remains(diagnosis) or "Nothing can be said about what is missing."
            return f"{known} Next: {_to_record(diagnosis)}"
        case "matches":
            here = "With what was added, the" if diagnosis.added else "The"
            return (
                f"{here} {judged(diagnosis)} is {rest} of the rms flow{floored(diagnosis)}. "
                f"{remains(diagnosis)}"
            )
        case "unknown":
            return (
                f"No known effect explains the {judged(diagnosis)} of {rest}{floored(diagnosis)}. "
                f"Next: Where shows {_where(diagnosis)}; an effect of your own goes into the "
                "project file as a formula."
            )
    return _first(diagnosis, diagnosis.found[0])


def _where(diagnosis: Diagnosis) -> str:
    """What the view Where has to show: no signals where the advice says that it follows none."""
    if any(FOLLOWS_NONE in line for line in diagnosis.advice):
        return "in which blocks and when it is largest"
    return "which signals it follows"


def _first(diagnosis: Diagnosis, first: FoundEffect) -> str:
    sizes = {name: value for name, value in first.parameters.items() if name != OVER}
    big = "".join(f", {quantity(v)} (95 %)" for v in sizes.values() if len(sizes) == 1)
    big += f" over {quantity(first.parameters[OVER])}" if big and OVER in first.parameters else ""
    before = percent(diagnosis, first.heldout_residual_before_m3s)
    after = percent(diagnosis, first.heldout_residual_after_m3s)
    does = hidden(first) or (
        f"Adding it lowers the {judged(diagnosis)} from {before} to {after}{floored(diagnosis)}."
    )
    words = f"{title(first.effect)} at {first.where}{big}. {does} {remains(diagnosis)}".rstrip()
    if first.cannot_be_told_from:
        others = ", ".join(
            title(name.partition(" (")[0]).lower() for name in first.cannot_be_told_from
        )
        words += f" This record cannot tell it from {others}: the choice is yours."
    rest = len(diagnosis.found) - 1
    return words + (f" {rest} more after it." if rest else "")
