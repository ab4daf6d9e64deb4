"""Plots over the time of a record: zoomed together, thinned at every zoom, spans marked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from bokeh.events import DoubleTap, SelectionGeometry
from bokeh.models import (
    BoxAnnotation,
    BoxSelectTool,
    BoxZoomTool,
    ColumnDataSource,
    Range1d,
    WheelZoomTool,
)
from bokeh.plotting import figure

from rtid.colours import HELD_OUT, INK, SEEN
from rtid.ui.lines import Line
from rtid.ui.look import Look
from rtid.ui.theme import INK_TAG, LIT, plot

DARK = {SEEN: "#182a36", HELD_OUT: "#33290f"}
MARGIN = 0.01  # of the record, at either end
EMPTY = Line(np.empty(0), np.empty(0))
Spans = list[tuple[float, float]]


class TimePlots:
    """Plots over time that are zoomed together; every zoom thins their lines anew.

    Each view has a range of its own, which takes over what the view before it has seen: what is
    hidden costs nothing while somebody zooms.
    """

    def __init__(
        self,
        parts: dict[str, tuple[float, float]],
        on_span: Callable[[float, float], None],
        on_zoom: Callable[[], None],
    ) -> None:
        self._parts = parts
        low, high = min(a for a, _ in parts.values()), max(b for _, b in parts.values())
        margin = MARGIN * (high - low)
        self.whole = low - margin, high + margin
        self._ranges: dict[str, Range1d] = {}
        self._lines: dict[str, list[tuple[Line, ColumnDataSource]]] = {}
        self._drawn: dict[str, tuple[float, float]] = {}  # what a view's lines were thinned for
        self.view = ""  # the one that is looked at, or made
        self._lit = ColumnDataSource({"x0": [], "x1": []})
        self._plots: list[figure] = []
        self._on_span, self._on_zoom = on_span, on_zoom
        self.drag = "zoom"

    @property
    def x(self) -> Range1d:
        """The range of the view that is looked at."""
        if self.view not in self._ranges:
            made = Range1d(*self.whole, bounds=self.whole)
            for end in ("start", "end"):
                made.on_change(end, lambda _attr, _old, _new: self._on_zoom())
            self._ranges[self.view] = made
        return self._ranges[self.view]

    def look_at(self, view: str) -> None:
        """Another view, at the same time of the record."""
        low, high = self.seen
        self.view = view
        if view in self._ranges and self.seen != (low, high):
            self.x.update(start=low, end=high)
        self.refresh()

    def plot(self, label: str, title: str = "") -> figure:
        """One more plot on the common time."""
        zoom, select = BoxZoomTool(dimensions="width"), BoxSelectTool(dimensions="width")
        select.overlay.fill_color, select.overlay.fill_alpha = LIT, 0.2
        wheel = WheelZoomTool(dimensions="width")
        made = plot(label, x_range=self.x, title=title, tools=[zoom, select, wheel, "xpan"])
        made.toolbar.active_drag, made.toolbar.active_scroll = zoom, wheel
        made.vstrip(
            x0="x0", x1="x1", source=self._lit, fill_color=LIT, fill_alpha=0.35, line_color=LIT,
            line_alpha=0.8, line_width=0.8,
        )  # fmt: skip
        self._shade(made)
        made.on_event(DoubleTap, lambda _: self.show_whole())
        made.on_event(SelectionGeometry, self._selected)
        self._plots.append(made)
        return made

    def line(self, made: figure, line: Line, colour: str, width: float) -> ColumnDataSource:
        """A line in a plot."""
        source = ColumnDataSource({"t": [], "y": []})
        drawn = made.line("t", "y", source=source, line_width=width)
        drawn.glyph.line_color = INK if colour == INK_TAG else colour
        drawn.nonselection_glyph = None
        if colour == INK_TAG:
            drawn.glyph.tags = [INK_TAG]
        self._lines.setdefault(self.view, []).append((line, source))
        return source

    def change(self, source: ColumnDataSource, line: Line) -> None:
        """Another line in the same place, drawn when its view is refreshed."""
        for view, lines in self._lines.items():
            for k, (_, known) in enumerate(lines):
                if known is source:
                    lines[k] = line, source
                    self._drawn.pop(view, None)

    @property
    def seen(self) -> tuple[float, float]:
        """The span of time that is seen."""
        ends: list[Any] = [self.x.start, self.x.end]
        return float(min(ends)), float(max(ends))

    def refresh(self) -> None:
        """Thin the lines of the view that is looked at for what is seen of the record now."""
        if self._drawn.get(self.view) == self.seen:
            return
        self._drawn[self.view] = self.seen
        for line, source in self._lines.get(self.view, []):
            t, y = line.between(*self.seen)
            source.data = {"t": t, "y": y}

    def _shade(self, made: figure) -> None:
        """What the fit has seen, and what it has not."""
        for name, (low, high) in self._parts.items():
            colour = SEEN if name == "identification" else HELD_OUT
            box = BoxAnnotation(left=low, right=high, fill_color=colour, fill_alpha=1.0)
            box.line_color, box.level = None, "image"
            box.tags = [{"light": colour, "dark": DARK[colour]}]
            made.add_layout(box)

    def light(self, spans: Spans) -> None:
        """Mark time spans."""
        self._lit.data = {"x0": [a for a, _ in spans], "x1": [b for _, b in spans]}

    def set_drag(self, mode: str) -> None:
        """Dragging zooms or selects a span."""
        self.drag = mode if mode in ("zoom", "span") else "zoom"
        kind = BoxZoomTool if self.drag == "zoom" else BoxSelectTool
        for made in self._plots:
            made.toolbar.active_drag = next(t for t in made.toolbar.tools if isinstance(t, kind))

    def zoom(self, factor: float) -> None:
        """In or out about the middle."""
        low, high = self.seen
        self._to(0.5 * (low + high) - 0.5 * factor * (high - low), factor * (high - low))

    def pan(self, share: float) -> None:
        """Earlier or later by a share of what is seen."""
        low, high = self.seen
        self._to(low + share * (high - low), high - low)

    def show_whole(self) -> None:
        """The whole record."""
        self.x.update(start=self.whole[0], end=self.whole[1])

    def _to(self, low: float, width: float) -> None:
        width = min(width, self.whole[1] - self.whole[0])
        low = float(np.clip(low, self.whole[0], self.whole[1] - width))
        self.x.update(start=low, end=low + width)

    def _selected(self, event: SelectionGeometry) -> None:
        where: Any = event.geometry
        if event.final and where and "x0" in where:
            ends = float(where["x0"]), float(where["x1"])
            self._on_span(min(ends), max(ends))


def spans_of(look: Look) -> dict[str, tuple[float, float]]:
    """When the parts of a record begin and end."""
    found = {n: p.equation.intervals.t_s for n, p in look.parts.items()}
    return {n: (float(t[0]), float(t[-1])) for n, t in found.items() if len(t)}
