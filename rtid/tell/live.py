"""Charts as Bokeh's plots: of the page, and of a report, which needs no server."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from bokeh.layouts import column
from bokeh.models import ColumnDataSource, Range1d, Title, UIElement, Whisker
from bokeh.plotting import figure

from rtid.plain import FloatArray
from rtid.tell.charts.lines import Lines
from rtid.tell.charts.theme import INK_TAG, NARROWEST_PX, NOTE_TAG, beside, plot, styled
from rtid.tell.charts.time_plots import TimePlots
from rtid.tell.colours import GREY, INK
from rtid.tell.story import Chart, Dots, Panel

ROOM = 0.06  # of the span, free at either end
INCH_PX = 90.0  # of a chart's heights
MARKERS = {"o": "circle", "s": "square"}


class PanelPlot:
    """One panel of points and straight lines, which can be shown others of the same kind."""

    def __init__(self, panel: Panel) -> None:
        self._x, self._y = Range1d(0, 1), Range1d(0, 1)
        self.root: figure = plot("", x_range=self._x, y_range=self._y)
        self.root.hspan(0.0, line_color=GREY, line_width=0.6)
        self._lines = [self._line(line.colour) for line in panel.lines]
        noted = [self._note(points) for points in reversed(panel.points) if points.note]
        self._notes = noted[::-1]  # the first one is added last, and stands highest
        self._points = [self._series(points) for points in panel.points]
        self.show(panel)

    def _line(self, colour: str) -> ColumnDataSource:
        source = ColumnDataSource({"x": [], "y": []})
        self.root.line("x", "y", source=source, line_color=colour, line_dash=[5, 4])
        return source

    def _note(self, points: Dots) -> Title:
        """The figure that a series stands for, above the plot and in its colour."""
        note = styled(Title(text=points.note, tags=[NOTE_TAG], text_color=points.colour))
        note.text_font_style, note.text_font_size, note.standoff = "normal", "10.5px", 1
        self.root.add_layout(note, "above")
        return note

    def _series(self, points: Dots) -> ColumnDataSource:
        source = ColumnDataSource({"x": [], "mean": [], "low": [], "high": []})
        marker, colour = MARKERS[points.marker], points.colour
        self.root.scatter("x", "mean", source=source, marker=marker, color=colour, size=6)
        if points.is_joined:
            self.root.line("x", "mean", source=source, color=colour, line_width=0.8)
        whisker = Whisker(base="x", lower="low", upper="high", source=source)
        whisker.line_color, whisker.upper_head, whisker.lower_head = colour, None, None
        self.root.add_layout(whisker)
        return source

    def show(self, panel: Panel, on_scale: Sequence[Panel] = ()) -> None:
        """Draw a panel; on_scale: others that have the same scale of y."""
        for source, points in zip(self._points, panel.points, strict=True):
            low, high = _interval(points)
            source.data = {"x": points.x, "mean": points.y, "low": low, "high": high}
        for source, line in zip(self._lines, panel.lines, strict=True):
            source.data = {"x": line.x, "y": line.y}
        for note, points in zip(self._notes, panel.points, strict=False):
            note.text = f"{points.name}: {points.note}"
        self._x.update(**_reach(points.x for points in panel.points))
        self._y.update(**_reach(_ends([panel, *on_scale])))
        self.root.title.text = panel.title
        self.root.xaxis.axis_label, self.root.yaxis.axis_label = panel.x_label, panel.y_label


def _ends(panels: Sequence[Panel]) -> Iterable[FloatArray]:
    for points in (p for panel in panels for p in panel.points):
        yield from _interval(points)


def _interval(points: Dots) -> tuple[FloatArray, FloatArray]:
    error = np.zeros(len(points.y)) if points.error is None else points.error
    return points.y - error, points.y + error


def _reach(values: Iterable[FloatArray]) -> dict[str, float]:
    """The span of values with some room, or 0 to 1 where there is none."""
    every = np.concatenate([*values, np.empty(0)])
    known = every[np.isfinite(every)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    room = ROOM * (high - low) or 0.5
    return {"start": low - room, "end": high + room}


def draw(chart: Chart) -> UIElement:
    """All panels of a chart; one below the other where the page is narrow."""
    return _over_time(chart) if chart.is_timed else _of_points(chart)


def _of_points(chart: Chart) -> UIElement:
    every = [panel for row in chart.panels for panel in row]
    rows = []
    for panels in chart.panels:
        shown = {"all": every, "row": panels, "none": ()}[chart.common]
        made = []
        for panel in panels:
            drawn = PanelPlot(panel)
            drawn.show(panel, shown)
            made.append(drawn.root)
        rows.append(_framed(made, chart.size_in[1] * INCH_PX * panels[0].height))
    return column(*rows, sizing_mode="stretch_width")


def _over_time(chart: Chart) -> UIElement:
    """Lines over the time of a record, every column on the same scales, zoomed together."""
    spans = {s.name: (s.low, s.high) for s in chart.panels[0][0].shades}
    time, columns = TimePlots(spans), []
    for panels in zip(*chart.panels, strict=True):
        lines, made, last = Lines(), [], len(panels) - 1
        values: dict[str, FloatArray] = {}
        for r, panel in enumerate(panels):
            made.append(time.plot("report", panel.y_label, panel.title, r == last))
            for k, line in enumerate(panel.lines):
                name = f"{r} {k}"
                colour = INK_TAG if line.colour == INK else line.colour
                lines.add(made[-1], name, colour, line.width)
                values[name] = line.y
        lines.show([(panels[0].lines[0].x, values)])
        columns.append(made)
    for others in columns[1:]:
        for first, other in zip(columns[0], others, strict=True):
            other.y_range = first.y_range
    height_px = INCH_PX * chart.size_in[1] * sum(row[0].height for row in chart.panels)
    return _framed([column(*c, sizing_mode="stretch_both") for c in columns], height_px)


def _framed(made: Sequence[UIElement], height_px: float) -> UIElement:
    """Side by side in a height; one below the other, each as high, where there is no room."""
    whole_px = f"{height_px * len(made):.0f}px !important"
    stacked = f":host {{ height: {whole_px}; flex-basis: {whole_px}; }}"
    return column(
        beside(*made, stacked_below_px=NARROWEST_PX),
        height=round(height_px),
        sizing_mode="stretch_width",
        stylesheets=[f"@media (max-width: {NARROWEST_PX}px) {{ {stacked} }}"],
    )
