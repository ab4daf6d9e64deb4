"""The frame of a report: one HTML file with style, scripts and plots inside, nothing to load.

Bokeh's script is part of the file: plots over time are zoomed by dragging, a double click shows the
whole record again.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from itertools import count
from string import Template

from bokeh.embed import components
from bokeh.resources import INLINE

from rtid.tell.html import static, text
from rtid.tell.live import draw
from rtid.tell.story import Chart, Planes, StoryPart


def page_of(**places: str) -> str:
    """The whole text; places: HTML by the names of `static/report.html`."""
    return Template(static("report.html")).substitute(places)


def key_figures(figures: Mapping[str, str]) -> str:
    """Cards of a value and what it is."""
    return "".join(
        f"<div><b>{text(value)}</b><span>{text(name)}</span></div>"
        for name, value in figures.items()
    )


def embedded(parts: Iterable[StoryPart]) -> tuple[str, dict[str, str]]:
    """What the head of the file needs, and the place of every chart; always the same text."""
    figures = {part.name: draw(part) for part in parts if isinstance(part, (Chart, Planes))}
    if not figures:
        return f"<style>{static('plots.css')}</style>", {}
    script, places = components(figures)
    words = _renumbered(json.dumps([script, places]))
    script, places = json.loads(words)
    resources = INLINE.clone(components=["bokeh"])
    head = (
        f"<style>{static('plots.css')}</style>{resources.render_js()}"
        f"<script>{static('plots.js', 'report.js')}</script>{script}"
    )
    return head, places


def _renumbered(words: str) -> str:
    """Ids in the order in which they appear, instead of what has been drawn before."""
    numbers, known = count(1), dict[str, str]()
    pattern = r"\bp\d{4,}\b(?=\\*\")|[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}"

    def new(result: re.Match[str]) -> str:
        return known.setdefault(result[0], f"p{next(numbers)}")

    return re.sub(pattern, new, words)
