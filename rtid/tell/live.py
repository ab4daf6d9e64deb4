"""Charts as Bokeh's plots: of the page, and of a report, which needs no server."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from bokeh.layouts import column
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    LinearColorMapper,
    Range1d,
    Title,
    UIElement,
    Whisker,
)
from bokeh.palettes import Cividis256, RdBu11, YlOrBr9, interp_palette
from bokeh.plotting import figure

from rtid.plain import FloatArray
from rtid.tell.charts.lines import Column
from rtid.tell.charts.theme import INK_TAG, NARROW_PX, NARROWEST_PX, NOTE_TAG, beside, plot, styled
from rtid.tell.charts.time_plots import TimePlots
from rtid.tell.colours import GREY, INK
from rtid.tell.story import Chart, Dots, Line, Panel, Plane, Planes, Strip

ROOM = 0.06  # of the span, free at either end
INCH_PX = 90.0  # of a chart's heights
PLANE_PX = 240.0  # height of a plane
PAIR = 2  # pictures that stand side by side on a narrow page too
BESIDE = 4  # pictures of a row at most
MARKERS = {"o": "circle", "s": "square", "c": "circle"}
YELLOWS = list(interp_palette(tuple(reversed(YlOrBr9)), 256))[8:232]
PALETTES = {"flow": list(Cividis256), "doubt": YELLOWS, "change": list(RdBu11)}
LABELS = 1.14  # of the span of x, where words stand behind points


class PanelPlot:
    """One panel of points and lines, which can be shown others of the same kind."""

    def __init__(self, panel: Panel) -> None:
        self._x, self._y = Range1d(0, 1), Range1d(0, 1)
        self.root: figure = plot("", x_range=self._x, y_range=self._y)
        if panel.has_zero:
            self.root.hspan(0.0, line_color=GREY, line_width=0.6)
        self._strips = [self._strip(strip) for strip in panel.strips]
        self._lines = [self._line(line) for line in panel.lines]
        noted = [self._note(points) for points in reversed(panel.points) if points.note]
        self._notes = noted[::-1]  # the first one is added last, and stands highest
        self._points = [self._series(points) for points in panel.points]
        self._remarks = self._words()
        self.show(panel)

    def _strip(self, strip: Strip) -> ColumnDataSource:
        source = ColumnDataSource({"xs": [], "ys": []})
        look = {"fill_color": strip.colour, "fill_alpha": 0.2, "line_color": None}
        self.root.patches("xs", "ys", source=source, **look)
        return source

    def _line(self, line: Line) -> ColumnDataSource:
        source = ColumnDataSource({"x": [], "y": []})
        dash = [5, 4] if line.is_dashed else "solid"
        look = {"line_color": line.colour, "line_width": line.width, "line_dash": dash}
        self.root.line("x", "y", source=source, **look)
        return source

    def _words(self) -> ColumnDataSource:
        """Of remarks, behind their points."""
        source = ColumnDataSource({"x": [], "y": [], "text": []})
        look = {"text_font_size": "10px", "text_baseline": "middle", "text_color": GREY}
        label = self.root.text("x", "y", "text", source=source, x_offset=3, **look)
        label.glyph.tags = [INK_TAG]
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
        fill = None if points.marker == "c" else colour
        look = {"marker": marker, "line_color": colour, "fill_color": fill, "size": 6}
        self.root.scatter("x", "mean", source=source, **look)
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
        for source, strip in zip(self._strips, panel.strips, strict=True):
            source.data = _around(strip)
        labels = [r for r in panel.remarks if r.y is not None]
        self._remarks.data = {k: [getattr(r, k) for r in labels] for k in ("x", "y", "text")}
        for note, points in zip(self._notes, panel.points, strict=False):
            note.text = f"{points.name}: {points.note}"
        if panel.ticks:
            self.root.xaxis.ticker = list(range(len(panel.ticks)))
            self.root.xaxis.major_label_overrides = dict(enumerate(panel.ticks))
        self._x.update(**_across(panel))
        self._y.update(**_reach(_ends([panel, *on_scale])))
        self.root.title.text = panel.title
        self.root.xaxis.axis_label, self.root.yaxis.axis_label = panel.x_label, panel.y_label


def _around(strip: Strip) -> dict[str, list[FloatArray]]:
    """The outlines of a strip's pieces."""
    ends = np.flatnonzero(~np.isfinite(strip.x))
    pieces = [k[np.isfinite(strip.x[k])] for k in np.split(np.arange(len(strip.x)), ends)]
    there = [k for k in pieces if len(k)]
    return {
        "xs": [np.concatenate([strip.x[k], strip.x[k][::-1]]) for k in there],
        "ys": [np.concatenate([strip.low[k], strip.high[k][::-1]]) for k in there],
    }


def _across(panel: Panel) -> dict[str, float]:
    """Of x: its points, or its lines from end to end with room for words behind them."""
    if panel.ticks:
        return {"start": -0.5, "end": len(panel.ticks) - 0.5}
    if not panel.strips:
        return _reach(points.x for points in panel.points)
    every = np.concatenate([strip.x for strip in panel.strips])
    low, high = float(np.nanmin(every)), float(np.nanmax(every))
    return {"start": low, "end": low + LABELS * (high - low)}


def _ends(panels: Sequence[Panel]) -> Iterable[FloatArray]:
    for points in (p for panel in panels for p in panel.points):
        yield from _interval(points)
    for strip in (s for panel in panels for s in panel.strips):
        yield from (np.minimum(strip.low, 0.0), strip.high)


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


class PlanePlot:
    """An image over two quantities with lines on it, which can be shown others."""

    def __init__(self, plane: Plane, x_label: str, y_label: str) -> None:
        self._x, self._y = Range1d(0, 1), Range1d(0, 1)
        self.root: figure = plot(y_label, x_label, self._x, y_range=self._y)
        self.root.grid.visible = False
        self.root.yaxis.visible = bool(y_label)  # of a map of the command alone there is none
        self._mapper = LinearColorMapper(palette=PALETTES["flow"], nan_color="#dddddd")
        self._image = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        self.root.image(
            "image", "x", "y", "dw", "dh", source=self._image, color_mapper=self._mapper
        )
        self._outline = ColumnDataSource({"x0": [], "y0": [], "x1": [], "y1": []})
        for look in ({"line_color": "#ffffff", "line_width": 2.4}, {"line_color": "#22272b"}):
            self.root.segment("x0", "y0", "x1", "y1", source=self._outline, **look)
        if plane.points is not None:
            at = ColumnDataSource({"x": plane.points[:, 0], "y": plane.points[:, 1]})
            white = {"line_color": None, "fill_color": "#ffffff", "fill_alpha": 0.75}
            self.root.scatter("x", "y", source=at, size=2, **white)
        bar = ColorBar(color_mapper=self._mapper, width=9, padding=4, label_standoff=4)
        bar.major_label_text_font_size, bar.bar_line_color = "10px", None
        self.root.add_layout(bar, "right")
        self.show(plane)

    def show(self, plane: Plane, labels: tuple[str, str] | None = None) -> None:
        """Draw a plane; labels: of its axes, where it is over other quantities than before."""
        if labels is not None:
            self.root.xaxis.axis_label, self.root.yaxis.axis_label = labels
            self.root.yaxis.visible = bool(labels[1])
        (x, x_end), (y, y_end) = plane.x, plane.y
        self._mapper.update(palette=PALETTES[plane.palette], low=plane.low, high=plane.high)
        place = {"x": [x], "y": [y], "dw": [x_end - x], "dh": [y_end - y]}
        self._image.data = {"image": [plane.values.astype(np.float32)], **place}
        names = ("x0", "y0", "x1", "y1")
        self._outline.data = dict(zip(names, plane.outline.T.tolist(), strict=True))
        self.root.title.text = plane.title
        self._x.update(start=x, end=x_end)
        self._y.update(start=y, end=y_end)


def draw(chart: Chart | Planes) -> UIElement:
    """All panels of a chart; one below the other where the page is narrow."""
    if isinstance(chart, Planes):
        return _planes(chart)
    return _over_time(chart) if chart.is_timed else _of_points(chart)


def _planes(chart: Planes) -> UIElement:
    made = [PlanePlot(plane, chart.x_label, chart.y_label).root for plane in chart.planes]
    rows = [_framed(made[k : k + BESIDE], PLANE_PX) for k in range(0, len(made), BESIDE)]
    return column(*rows, sizing_mode="stretch_width")


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
        lines, made, last = time.lines("report"), [], len(panels) - 1
        values: dict[str, Column] = {}
        for r, panel in enumerate(panels):
            made.append(time.plot("report", panel.y_label, panel.title, r == last))
            for k, line in enumerate(panel.lines):
                name = f"{r} {k}"
                colour = INK_TAG if line.colour == INK else line.colour
                lines.add(made[-1], name, colour, line.width)
                values[name] = line.y.__getitem__
        lines.show([(panels[0].lines[0].x, values)])
        columns.append(made)
    for others in columns[1:]:
        for first, other in zip(columns[0], others, strict=True):
            other.y_range = first.y_range
    height_px = INCH_PX * chart.size_in[1] * sum(row[0].height for row in chart.panels)
    return _framed([column(*c, sizing_mode="stretch_both") for c in columns], height_px)


def _framed(made: Sequence[UIElement], height_px: float) -> UIElement:
    """Side by side in a height; one below the other, each as high, where there is no room."""
    narrow_px = NARROWEST_PX if len(made) <= PAIR else NARROW_PX
    whole_px = f"{height_px * len(made):.0f}px !important"
    stacked = f":host {{ height: {whole_px}; flex-basis: {whole_px}; }}"
    return column(
        beside(*made, stacked_below_px=narrow_px),
        height=round(height_px),
        sizing_mode="stretch_width",
        stylesheets=[f"@media screen and (max-width: {narrow_px}px) {{ {stacked} }}"],
    )
