"""The pictures of `rtid report`, made by the code of the page (`rtid.ui`); they need no server.

Bokeh's script is part of the file: plots over time are zoomed by dragging, a double click shows the
whole record again.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from itertools import count

from bokeh.embed import components
from bokeh.layouts import column, row
from bokeh.models import UIElement
from bokeh.resources import INLINE

from rtid.compare import Dependence
from rtid.diagnose.residual import Residual
from rtid.report_story import Ranked
from rtid.report_tables import named
from rtid.report_words import text
from rtid.ui.compare_view import flow_plots, flows_of
from rtid.ui.dependence_plot import DependencePlot
from rtid.ui.fragments import clearness, error_bars, static, table
from rtid.ui.lines import Lines
from rtid.ui.time_plots import TimePlots

FLOW_PX, DEPENDENCE_PX = 330, 210
PARTS = ("identification", "validation")
Models = Mapping[str, Sequence[Residual]]
BEGIN = """
plots.spareStyles();
(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const paint = () => plots.paint(dark.matches ? "dark" : "light");
  const begin = () => {
    const places = [...document.querySelectorAll("[data-root-id]")];
    if (!places.every((place) => place.firstElementChild)) return setTimeout(begin, 20);
    plots.follow(); paint(); document.body.dataset.ready = "yes";
  };
  dark.addEventListener("change", paint);
  document.addEventListener("dblclick", () => plots.move("report", { whole: true }));
  document.addEventListener("DOMContentLoaded", begin);
})();
"""


def errors(steps: Sequence[tuple[str, float]], floor: float) -> str:
    """Bars of the error behind each addition, % of the rms flow, as HTML."""
    return error_bars([(name, value, False) for name, value in steps], floor)


def ranking(ranked: Sequence[Ranked]) -> str:
    """How clearly the record shows each candidate, as HTML."""
    most = max((r.before or r.after or 0.0 for r in ranked), default=1.0) or 1.0
    rows = [(text(named(r.key)), *clearness(r.before, r.after, most)) for r in ranked]
    return table(("effect", "how clearly|", ""), rows)


def flows(chambers: Sequence[str], models: Models) -> UIElement:
    """Measured and modelled flow of every chamber, one column for each model, common scales."""
    first = next(iter(models.values()))
    spans = {
        name: (float(part.t_s[0]), float(part.t_s[-1]))
        for name, part in zip(PARTS, first, strict=True)
        if len(part.t_s)
    }
    time, columns = TimePlots(spans), []
    for title, parts in models.items():
        lines, made = Lines(), []
        for c, chamber in enumerate(chambers):
            name = f"chamber {chamber}, {title}"
            made += flow_plots(time, "report", lines, c, name, c == len(chambers) - 1)
        lines.show(flows_of(part.t_s, part.measured, part.left) for part in parts)
        columns.append(made)
    for others in columns[1:]:
        for one, other in zip(columns[0], others, strict=True):
            other.y_range = one.y_range
    return _framed(
        row(*(column(*c, sizing_mode="stretch_both") for c in columns), sizing_mode="stretch_both"),
        FLOW_PX * len(chambers),
    )


def dependences(chambers: Sequence[str], models: Mapping[str, Sequence[Dependence]]) -> UIElement:
    """Mean residual over every signal, one column for each model, common scales."""
    rows = []
    for found in zip(*models.values(), strict=True):
        made = []
        for one, title in zip(found, models, strict=True):
            plot = DependencePlot(chambers)
            plot.show(one, f"{title},", found[0])
            made.append(plot.root)
        rows.append(_framed(row(*made, sizing_mode="stretch_both"), DEPENDENCE_PX))
    return column(*rows, sizing_mode="stretch_width")


def _framed(made: UIElement, height_px: int) -> UIElement:
    return column(made, height=height_px, sizing_mode="stretch_width")


def embedded(figures: Mapping[str, UIElement]) -> tuple[str, dict[str, str]]:
    """What the head of the file needs, and the place of every figure; always the same text."""
    if not figures:
        return f"<style>{static('plots.css')}</style>", {}
    script, places = components(dict(figures))
    told = _renumbered(json.dumps([script, places]))
    script, places = json.loads(told)
    resources = INLINE.clone(components=["bokeh"])
    head = (
        f"<style>{static('plots.css')}</style>{resources.render_js()}"
        f"<script>{static('plots.js')}{BEGIN}</script>{script}"
    )
    return head, places


def _renumbered(told: str) -> str:
    """Ids in the order in which they appear, instead of what has been drawn before."""
    numbers, known = count(1), dict[str, str]()
    pattern = r"\bp\d{4,}\b(?=\\*\")|[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}"

    def new(found: re.Match[str]) -> str:
        return known.setdefault(found[0], f"p{next(numbers)}")

    return re.sub(pattern, new, told)
