"""Plots over the time of a record: zoomed together (`static/plots.js`), spans marked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bokeh.events import SelectionGeometry
from bokeh.models import BoxSelectTool, BoxZoomTool, ColumnDataSource, Range1d, WheelZoomTool
from bokeh.plotting import figure

from rtid.study.look import Look
from rtid.tell.charts.lines import Lines
from rtid.tell.charts.theme import LIT, lean, plot

# what the fit has seen, and what it has not: the same on a light and a dark ground
SEEN, HELD_OUT = ("#0072b2", 0.10), ("#e69f00", 0.14)
MARKED, EDGE = (LIT, 0.35), 0.8  # what the user has pointed at, and the ends of it
MARGIN = 0.01  # of the record, at either end
Spans = list[tuple[float, float]]


class TimePlots:
    """Plots over time that are zoomed together.

    Each view has a range of its own, which takes over what the view before it has seen: what is
    hidden costs nothing while somebody zooms.  Without `on_span` there is nobody to tell of a
    selected span, and the wheel scrolls: a report.
    """

    def __init__(
        self,
        parts: dict[str, tuple[float, float]],
        on_span: Callable[[float, float], None] | None = None,
    ) -> None:
        self._parts = parts
        low, high = min(a for a, _ in parts.values()), max(b for _, b in parts.values())
        margin = MARGIN * (high - low)
        self._whole = low - margin, high + margin
        self._ranges: dict[str, Range1d] = {}
        self._lit: dict[str, ColumnDataSource] = {}
        self._spans: Spans = []
        self._view = ""
        self._plots: list[figure] = []
        self._lines: dict[str, list[Lines]] = {}
        self._on_span, self._handles = on_span, BoxZoomTool().overlay.handles
        self.drag = "zoom"

    def plot(self, view: str, label: str, title: str = "", is_last: bool = True) -> figure:
        """One more plot on the common time; is_last: the one of a column that tells the time."""
        zoom, select = BoxZoomTool(dimensions="width"), BoxSelectTool(dimensions="width")
        zoom.overlay.handles = select.overlay.handles = self._handles
        select.overlay.fill_color, select.overlay.fill_alpha = LIT, 0.2
        wheel = WheelZoomTool(dimensions="width")
        tools = [zoom, select, wheel, "xpan"] if self._on_span else [zoom]
        made = plot(label, x_range=self._range(view), title=title, tools=tools)
        made.toolbar.active_drag = zoom
        if self._on_span:
            made.toolbar.active_scroll = wheel
        lean(made.vstrip(
            x0="x0", x1="x1", source=self._strips_of(view), fill_color="colour", fill_alpha="alpha",
            line_color="colour", line_alpha="edge", line_width=0.8, level="image",
        ))  # fmt: skip
        if is_last:
            made.xaxis.axis_label = "time in s"
        else:
            made.xaxis.visible, made.min_border_bottom = False, 8
        if self._on_span is not None:
            made.on_event(SelectionGeometry, self._selected)
        self._plots.append(made)
        return made

    def lines(self, view: str) -> Lines:
        """Lines of a view, which are sent more finely where somebody zooms to them."""
        made = Lines(is_whole=self._on_span is None)
        self._lines.setdefault(view, []).append(made)
        return made

    def zoom(self, view: str, low: float, high: float) -> None:
        """A view has come to a window of the record, s, that it has too few values of."""
        for lines in self._lines.get(view, []):
            lines.zoom(low, high)

    def _range(self, view: str) -> Range1d:
        if view not in self._ranges:
            name = f"time_{view}"
            self._ranges[view] = Range1d(*self._whole, bounds=self._whole, name=name, tags=["time"])
        return self._ranges[view]

    def _strips(self, marked: Spans) -> dict[str, list[Any]]:
        """The parts of the record, and what is marked in them."""
        looks = [SEEN if name == "identification" else HELD_OUT for name in self._parts]
        spans, looks = [*self._parts.values(), *marked], looks + [MARKED] * len(marked)
        return {
            "x0": [low for low, _ in spans],
            "x1": [high for _, high in spans],
            "colour": [colour for colour, _ in looks],
            "alpha": [alpha for _, alpha in looks],
            "edge": [EDGE if look is MARKED else 0.0 for look in looks],
        }

    def _strips_of(self, view: str) -> ColumnDataSource:
        if view not in self._lit:
            self._lit[view] = ColumnDataSource(self._strips([]))
        return self._lit[view]

    def light(self, spans: Spans) -> None:
        """Mark time spans."""
        self._spans = spans
        self.look_at(self._view)

    def look_at(self, view: str) -> None:
        """Another view: what is marked is marked there too, not before it is seen."""
        self._view = view
        strips, lit = self._strips(self._spans), self._lit.get(view)
        if lit is not None and dict(lit.data) != strips:
            lit.data = strips

    def set_drag(self, mode: str) -> None:
        """Dragging zooms or selects a span."""
        self.drag = mode if mode in ("zoom", "span") else "zoom"
        kind = BoxZoomTool if self.drag == "zoom" else BoxSelectTool
        for made in self._plots:
            made.toolbar.active_drag = next(t for t in made.toolbar.tools if isinstance(t, kind))

    def _selected(self, event: SelectionGeometry) -> None:
        where: Any = event.geometry
        if event.final and where and "x0" in where and self._on_span is not None:
            ends = float(where["x0"]), float(where["x1"])
            self._on_span(min(ends), max(ends))


def spans_of(look: Look) -> dict[str, tuple[float, float]]:
    """When the parts of a record begin and end."""
    times = {n: p.equation.intervals.t_s for n, p in look.parts.items()}
    return {n: (float(t[0]), float(t[-1])) for n, t in times.items() if len(t)}
