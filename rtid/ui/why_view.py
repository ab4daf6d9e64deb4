"""Why: what was found and how sure, the ranking of all candidates, and the page of an effect."""

from __future__ import annotations

from re import sub

from rtid.diagnose.report import Diagnosis, Effect, Unseen, Value
from rtid.diagnosed_text import percent, title
from rtid.effects import catalogue
from rtid.effects import effect as page_of
from rtid.effects.page import Effect as Page
from rtid.effects.page import EffectError, readable
from rtid.report_sizes import KEPT, limit, size
from rtid.report_story import Ranked
from rtid.report_tables import named
from rtid.report_words import VERDICTS, text
from rtid.ui.desk import Told
from rtid.ui.fragments import button, clearness, table
from rtid.ui.verdict_words import judged, said
from rtid.units import PRACTICAL

MOST = 18  # candidates that are shown


def fragments(told: Told | None, page: str, may_add: bool) -> dict[str, str]:
    """The ranking on the left, the page of the chosen effect on the right."""
    if told is None:
        waiting = '<p class="says">Every known effect is being held beside the model.</p>'
        return {"why_ranking": waiting, "why_page": effect_page(page)}
    found = told.diagnosis
    parts = [_found(found, e) for e in found.found]
    if found.verdict != "insufficient_data":
        parts.append(_ranking(told, may_add))
    parts += _unseen(found)
    if not found.found:
        kind, heading = VERDICTS[found.verdict]
        words = f"{said(found)}{_present(found)}"
        parts.insert(0, f'<div class="card"><h2 class="{kind}">{heading}</h2>{text(words)}</div>')
    chosen = page or next((e.effect for e in found.found), "")
    return {"why_ranking": "".join(parts), "why_page": effect_page(chosen)}


def _link(name: str, label: str) -> str:
    return button(label, "page", kind="link", name=name) if name in catalogue() else text(label)


def _present(found: Diagnosis) -> str:
    """What is there and changes next to nothing."""
    names = ", ".join(named((s.effect, s.where)) for s in found.negligible)
    return f" Too small to matter, if there at all: {names}." if names else ""


def _found(found: Diagnosis, effect: Effect) -> str:
    """What was found: size with interval, held-out gain, what it may be confused with."""
    sizes = "".join(
        f"<dt>{text(name.replace('_', ' '))}</dt><dd>{text(_interval(value))}</dd>"
        for name, value in effect.parameters.items()
    )
    before, after = effect.heldout_residual_before_m3s, effect.heldout_residual_after_m3s
    alike = ", ".join(title(name.partition(" (")[0]) for name in effect.cannot_be_told_from)
    told_apart = (
        f"cannot be told from {alike} in this record" if alike else "no other known effect does"
    )
    return (
        f'<div class="card"><h2 class="found">{_link(effect.effect, title(effect.effect))} '
        f"at {text(effect.where)}</h2><dl>{sizes}<dt>{judged(found)}</dt><dd>"
        f"{percent(found, before)} → <b>{percent(found, after)}</b> of the rms flow; the sensors' "
        f"floor is {percent(found, found.noise_floor_m3s)}</dd><dt>explains as much</dt>"
        f"<dd>{text(told_apart)}</dd><dt>by chance</dt><dd>"
        f"{_chance(effect.p_value)}</dd></dl>{_choices(effect)}</div>"
    )


def _chance(p: float) -> str:
    return f"p = {p:.1g}" if p > 0 else "p below 1e-300"


def _choices(effect: Effect) -> str:
    """A button for each of a set that the record does not tell apart."""
    if not effect.cannot_be_told_from:
        return ""
    members = [(effect.effect, effect.where)]
    for name in effect.cannot_be_told_from:
        other, _, where = name.rstrip(")").partition(" (")
        members.append((other, where or effect.where))
    made = "".join(button(f"Add {named(m)}", "add", effect=m[0], where=m[1]) for m in members)
    return f"<p>{text('The record leaves the choice to you: ')}{made}</p>"


def _interval(value: Value) -> str:
    """With its 95 % interval; a coefficient in SI too, as the project file has it."""
    known = "" if value.std != value.std else " (95 %)"
    si = ""
    if value.unit in PRACTICAL and value.unit not in KEPT:
        si = f", {value.value:.4g} {value.unit}"
    return f"{size(value)}{known}{si}"


def _ranking(told: Told, may_add: bool) -> str:
    """All candidates by how clearly the record shows each, with a button to add it."""
    most = max((r.before or r.after or 0.0 for r in told.ranking), default=1.0) or 1.0
    rows = [_rank(one, most, may_add) for one in told.ranking[:MOST]]
    head = ("effect", "how clearly|", "", "size ± 95 %", "")
    says = (
        "How clearly the record shows each effect when it is added alone: its coefficient in "
        "standard deviations (bar: logarithmic). "
    )
    if told.diagnosis.found:
        says += (
            "While something large is missing, many effects imitate it; → is what is left of "
            "them once the orange one is in the model. Next: add what is found, or open a page."
        )
    elif told.diagnosis.verdict == "matches":
        says += (
            "None of them takes a material share of the error off unseen motion, however clear "
            "it is. "
        )
        if told.diagnosis.negligible:
            says += "→ is what is left of them beside those that are too small to matter. "
        says += "An effect's name opens its page."
    else:
        says += "None of them explains the error. An effect's name opens its page."
    return f'<h3>All candidates</h3><p class="says">{text(says)}</p>{table(head, rows)}'


def _rank(one: Ranked, most: float, may_add: bool) -> tuple[str, ...]:
    words, bar = clearness(one.before, one.after, most)
    big = size(Value(one.value, one.std, one.unit))
    if one.per_shape is not None:
        big += f" of {limit(*one.per_shape)}"
    remark = "" if one.is_possible else ", not possible"
    can = may_add and one.is_possible
    add = button("Add", "add", effect=one.key[0], where=one.key[1]) if can else ""
    return _link(one.key[0], named(one.key)), text(words), bar, text(big + remark), add


def _unseen(found: Diagnosis) -> list[str]:
    """Detection limits, and what the record cannot show."""
    listed = () if found.verdict == "insufficient_data" else found.not_found
    seen = [u for u in listed if u.visible and u.detection_limit is not None]
    blind = [u for u in found.not_found if not u.visible]
    head = ("effect", "where", "smallest size that would have shown", "remark")
    parts = []
    if seen:
        rows = [(*_place(u), text(_limit(u)), text(u.reason)) for u in seen]
        parts.append("<h3>Looked for and not found</h3>" + table(head, rows))
    if blind:
        hidden = [(*_place(u), text(u.reason)) for u in blind]
        parts.append("<h3>This record cannot show</h3>" + table(("effect", "where", "why"), hidden))
    if found.advice:
        items = "".join(f"<li>{text(_with_titles(a))}</li>" for a in found.advice)
        parts.append(f"<h3>What motion would tell more</h3><ul>{items}</ul>")
    return parts


def _with_titles(advice: str) -> str:
    """Advice with the titles of effects in place of their names."""
    known = catalogue()
    return sub(r"[a-z]+_\w+", lambda m: title(m[0]) if m[0] in known else m[0], advice)


def _place(unseen: Unseen) -> tuple[str, str]:
    return _link(unseen.effect, title(unseen.effect)), text(unseen.where)


def _limit(unseen: Unseen) -> str:
    return limit(unseen.detection_limit or 0.0, unseen.unit)


def effect_page(name: str) -> str:
    """Equation, signature in the residual, reference."""
    if not name:
        return '<p class="says">Click an effect: its equation, its signature, its reference.</p>'
    try:
        page = page_of(name)
    except EffectError:
        return f'<h2>{text(title(name))}</h2><p class="says">an effect of your own</p>'
    return _page(page)


def _page(page: Page) -> str:
    lines = "\n".join(readable(line) for line in page.equation)
    symbols = "".join(
        f"<dt>{text(s.name)}{text(f' ({s.unit})' if s.unit else '')}</dt><dd>{text(s.meaning)}</dd>"
        for s in page.symbols
    )
    sizes = "".join(
        f"<dt>{text(p.name.replace('_', ' '))}, {text(p.symbol)}</dt><dd>{p.low:g} to {p.high:g} "
        f"{text('' if p.unit == '1' else p.unit)}. {text(p.meaning)}</dd>"
        for p in page.parameters
    )
    invisible = "<p><b>Structurally invisible:</b> a free map swallows it.</p>"
    rest = "".join(
        f"<h3>{heading}</h3>{text(words)}"
        for heading, words in (
            ("In the residual", page.signature),
            ("Looks like", ", ".join(title(name) for name in page.confounders)),
            ("What tells them apart", page.separates),
            ("Visible when", page.visible_when),
            ("Reference", page.reference),
        )
        if words
    )
    return (
        f"<h2>{text(page.title)}</h2><p>{text(page.summary)}</p>"
        f"{invisible if page.invisible else ''}<pre>{text(lines)}</pre><dl>{symbols}{sizes}</dl>"
        f"{rest}"
    )
