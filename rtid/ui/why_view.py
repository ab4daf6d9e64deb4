"""Why: what was found and how sure, the ranking of all candidates, and the page of an effect."""

from __future__ import annotations

from collections.abc import Mapping
from re import sub

from bokeh.layouts import column
from bokeh.models import UIElement

from rtid.diagnose.report import Diagnosis, FoundEffect, Unseen, Value
from rtid.effects import catalogue
from rtid.effects import effect as page_of
from rtid.effects.page import Effect as Page
from rtid.effects.page import EffectError, readable, title
from rtid.tell.charts.theme import NARROWEST_PX, beside
from rtid.tell.diagnosed import (
    LIMITS,
    floored,
    folded,
    hidden,
    in_the_moduli,
    judged,
    limits,
    limits_say,
    percent,
    remark,
    seen_and_not_named,
)
from rtid.tell.html import button, clearness, table, text
from rtid.tell.live import PanelPlot
from rtid.tell.report_story import Ranked, sizes_say
from rtid.tell.story import Chart
from rtid.tell.words import named, quantity
from rtid.ui.desk import RankedDiagnosis
from rtid.ui.desk_views import Bench
from rtid.ui.views import PageView
from rtid.units import limit, range_of, scale_of

MOST = 18  # candidates that are shown


class WhyView(PageView):
    """The ranking on the left; the evidence and the page of the chosen effect on the right."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        self._page = ""
        self._place = column(sizing_mode="stretch_both")
        self._chart: Chart | None = None
        self.roots, self.actions = {"plot": self._place}, {"page": self._open}

    @property
    def told(self) -> RankedDiagnosis | None:
        """What is missing in the newest revision; None until it has been diagnosed."""
        return self.bench.session.revisions[-1].told

    @property
    def chart(self) -> Chart | None:
        """The evidence for the effect whose page is open, or for the first that is named."""
        words = self.told
        charts = words.evidence if words else ()
        names = [effect.effect for effect in words.diagnosis.found] if words else []
        at = names.index(self._page) if self._page in names else 0
        return charts[at] if charts else None

    def _open(self, asked: dict[str, str]) -> None:
        """The page of an effect."""
        self._page = asked.get("name", "")
        self.refresh()

    def refresh(self) -> None:
        """Draw the evidence, where it is another."""
        chart = self.chart
        if chart is not self._chart:
            self._chart = chart
            self._place.children = [drawn(chart)] if chart else []

    def fragments(self) -> Mapping[str, str]:
        """Ranking, page, and what the evidence says."""
        says = text(self.chart.caption) if self.chart else ""
        return fragments(self.told, self._page, may_add=True) | {"says": says}


def drawn(chart: Chart) -> UIElement:
    """The panels of a chart in their rows; one below the other where the page is narrow."""
    every = [panel for panels in chart.panels for panel in panels]
    rows = []
    for panels in chart.panels:
        plots = [PanelPlot(panel) for panel in panels]
        for plot, panel in zip(plots, panels, strict=True):
            plot.show(panel, every if chart.common == "all" else ())
        rows.append(beside(*(plot.root for plot in plots), stacked_below_px=NARROWEST_PX))
    return column(*rows, sizing_mode="stretch_both")


def fragments(ranked: RankedDiagnosis | None, page: str, may_add: bool) -> dict[str, str]:
    """The ranking on the left, the page of the chosen effect on the right."""
    if ranked is None:
        waiting = '<p class="says">Every known effect is being held beside the model.</p>'
        return {"ranking": waiting, "page": effect_page(page)}
    diagnosis = ranked.diagnosis
    parts = [_found(diagnosis, e) for e in diagnosis.found]
    if diagnosis.verdict != "insufficient_data":
        parts.append(_ranking(ranked, may_add))
    parts += _unseen(diagnosis)
    seen = [*seen_and_not_named(diagnosis), *in_the_moduli(diagnosis)]
    if words := "" if diagnosis.found else " ".join(seen):
        parts.insert(0, f'<div class="card">{text(words)}</div>')
    chosen = page or next((e.effect for e in diagnosis.found), "")
    return {"ranking": "".join(parts), "page": effect_page(chosen)}


def _link(name: str, label: str) -> str:
    return button(label, "page", kind="link", name=name) if name in catalogue() else text(label)


def _found(diagnosis: Diagnosis, effect: FoundEffect) -> str:
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
    bends = hidden(effect) if effect is not diagnosis.found[0] else ""  # that one: above the view
    return (
        f'<div class="card"><h2 class="found">{_link(effect.effect, title(effect.effect))} '
        f"at {text(effect.where)}</h2><dl>{sizes}<dt>{judged(diagnosis)}</dt><dd>"
        f"{percent(diagnosis, before)} → <b>{percent(diagnosis, after)}</b> of the rms flow"
        f"{floored(diagnosis)}</dd><dt>explains as much</dt>"
        f"<dd>{text(told_apart)}</dd><dt>by chance</dt><dd>"
        f"{_chance(effect.p_value)}</dd></dl>{text(bends)}{_choices(effect)}</div>"
    )


def _chance(p: float) -> str:
    return f"p = {p:.1g}" if p > 0 else "p below 1e-300"


def _choices(effect: FoundEffect) -> str:
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
    if "/" in value.unit and scale_of(value.unit).name != value.unit:
        si = f", {value.value:.4g} {value.unit}"
    return f"{quantity(value)}{known}{si}"


def _ranking(ranked: RankedDiagnosis, may_add: bool) -> str:
    """All candidates by how clearly the record shows each, with a button to add it."""
    most = max((r.before or r.after or 0.0 for r in ranked.ranking), default=1.0) or 1.0
    rows = [_rank(ranked, most, may_add) for ranked in ranked.ranking[:MOST]]
    head = ("effect", "how clearly|", "", "size ± 95 %", "")
    says = (
        "How clearly the record shows each effect when it is added alone: its coefficient in "
        "standard deviations (bar: logarithmic). "
    )
    if ranked.diagnosis.found:
        says += (
            "While something large is missing, many effects imitate it; → is what is left of "
            "them once the orange one is in the model. Next: add what is found, or open a page."
        )
    elif ranked.diagnosis.verdict == "matches":
        says += (
            "None of them takes a material share of the error off unseen motion, however clear "
            "it is. "
        )
        if ranked.diagnosis.negligible:
            says += "→ is what is left of them beside those that are too small to matter. "
        says += "An effect's name opens its page."
    else:
        says += "None of them explains the error. An effect's name opens its page."
    says += f" {sizes_say(ranked.ranking, 'size')}"
    return f'<h3>All candidates</h3><p class="says">{text(says)}</p>{table(head, rows, "ranking")}'


def _rank(ranked: Ranked, most: float, may_add: bool) -> tuple[str, ...]:
    words, bar = clearness(ranked.before, ranked.after, most)
    big = quantity(Value(ranked.value, ranked.std, ranked.unit))
    if ranked.per_shape is not None:
        big += f" of {limit(*ranked.per_shape)}"
    remark = "" if ranked.is_possible else ", not possible"
    can = may_add and ranked.is_possible
    add = button("Add", "add", effect=ranked.key[0], where=ranked.key[1]) if can else ""
    return _link(ranked.key[0], named(ranked.key)), text(words), bar, text(big + remark), add


def _unseen(diagnosis: Diagnosis) -> list[str]:
    """Detection limits, and what the record cannot show."""
    listed = () if diagnosis.verdict == "insufficient_data" else diagnosis.not_found
    seen = [u for u in listed if u.visible and u.detection_limit is not None]
    blind = [u for u in folded(diagnosis.not_found) if not u.visible or u.detection_limit is None]
    head = ("effect", "where", *LIMITS, "remark")
    parts = []
    if seen:
        says = f'<p class="says">{text(limits_say(diagnosis))}</p>'
        rows = [(*_place(u), *map(text, limits(u)), text(remark(u))) for u in seen]
        parts.append(f"<h3>Looked for and not found</h3>{says}{table(head, rows)}")
    if blind:
        hidden = [(*_place(u), text(u.reason)) for u in blind]
        parts.append("<h3>This record cannot show</h3>" + table(("effect", "where", "why"), hidden))
    if diagnosis.advice:
        items = "".join(f"<li>{text(_with_titles(a))}</li>" for a in diagnosis.advice)
        parts.append(f"<h3>What motion would tell more</h3><ul>{items}</ul>")
    return parts


def _with_titles(advice: str) -> str:
    """Advice with the titles of effects in place of their names."""
    known = catalogue()
    return sub(r"[a-z]+_\w+", lambda m: title(m[0]) if m[0] in known else m[0], advice)


def _place(unseen: Unseen) -> tuple[str, str]:
    return _link(unseen.effect, title(unseen.effect)), text(unseen.where)


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
        f"<dt>{text(p.name.replace('_', ' '))}, {text(p.symbol)}</dt><dd>"
        f"{text(range_of(p.low, p.high, p.unit))}. {text(p.meaning)}</dd>"
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
