"""One quiet style for all pictures: few colours that every eye can tell apart, no ornament."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch, Rectangle

from rtid.estimator.flowmap import EXTRAPOLATED, LEARNING, PRIOR, SHUT, VALID
from rtid.plain import FloatArray
from rtid.tell.colours import BLUE, GREY, INK, LINE, ORANGE, PALE
from rtid.tell.story import Bar, Bars, Chart, Dots, Panel, Plane, Planes, Remark

FILL = {VALID: "#b9d9ec", LEARNING: "#f6e3b4", EXTRAPOLATED: "white", PRIOR: "white", SHUT: PALE}
LABELS = {
    VALID: "valid",
    LEARNING: "learning",
    EXTRAPOLATED: "no data: extrapolated",
    PRIOR: "no data: rated value",
    SHUT: "shut",
}
DPI = 160
GAP = 5.0  # usual steps: no line across a longer one
INSIDE = 0.25  # of the axis: a longer bar has its figure inside
WEAKEST = 0.1  # left end of a logarithmic scale
PALETTES = {"flow": "cividis", "doubt": "YlOrBr", "change": "RdBu_r"}
LEVELS = 12  # of a plane's colours
VEIL, HATCH = (1.0, 1.0, 1.0, 0.35), (1.0, 1.0, 1.0, 0.75)
BAR_COLOURS = {"first": ORANGE, "found": ORANGE, "rival": LINE}

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "font.family": "DejaVu Sans",
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 6,
    "axes.labelsize": 9,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.2,
    "hatch.linewidth": 0.6,
    "svg.hashsalt": "rtid",
    "figure.constrained_layout.use": True,
}


def panels(count: int, width: float = 9.0, height: float = 3.2) -> tuple[Figure, list[Axes]]:
    """A figure of `count` axes in at most two columns, axes shared; sizes in inches per row."""
    columns = min(2, count)
    rows = -(-count // columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width * columns / 2, height * rows + 0.5))
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    axes = list(grid.ravel())
    for unused in axes[count:]:
        unused.remove()
    return figure, axes[:count]


def label_outer(axes: Sequence[Axes], x: str, y: str) -> None:
    """Axis labels on the outer panels only."""
    for axis in axes:
        spec = axis.get_subplotspec()
        axis.set_xlabel(x if spec is None or spec.is_last_row() else "")
        axis.set_ylabel(y if spec is None or spec.is_first_col() else "")


def save(figure: Figure, path: Path) -> Path:
    """Write the picture in the format that the suffix names (.png, .svg), without a date.

    A PNG goes past `savefig`, which draws all of it once more, to lay it out before.
    """
    with mpl.rc_context(STYLE):
        if path.suffix == ".png":
            figure.set_dpi(DPI)
            canvas: Any = FigureCanvasAgg(figure)
            canvas.print_png(path)
        else:
            dated: dict[str, str | None] | None = {"Date": None} if path.suffix == ".svg" else None
            figure.savefig(path, dpi=DPI, metadata=dated)
    return path


def thin(t: FloatArray, y: FloatArray, bins: int = 1500) -> tuple[FloatArray, FloatArray]:
    """Least and largest value of each of `bins` equal runs, in their order: no spike is lost.

    t (n,) and y (n,) in any units; the result in the same.
    """
    n = len(y)
    if n <= 2 * bins:
        return t, y
    size = -(-n // bins)
    padded = np.concatenate([y, np.full(-n % size, y[-1])]).reshape(-1, size)
    start = size * np.arange(len(padded))
    at = np.sort(np.stack([start + padded.argmin(axis=1), start + padded.argmax(axis=1)]), axis=0)
    chosen = np.unique(np.minimum(at.T.ravel(), n - 1))
    return t[chosen], y[chosen]


def draw(chart: Chart | Planes | Bars) -> Figure:
    """A chart as a still."""
    with mpl.rc_context(STYLE):
        if isinstance(chart, Planes):
            return _planes(chart)
        return _bars(chart) if isinstance(chart, Bars) else _panels(chart)


def _planes(chart: Planes) -> Figure:
    figure, axes = panels(len(chart.planes))
    for axis, plane in zip(axes, chart.planes, strict=True):
        drawn = _plane(axis, plane)
        if not chart.y_label:  # over the command alone
            axis.set_yticks([])
    label_outer(axes, chart.x_label, chart.y_label)
    bar = figure.colorbar(drawn, ax=axes, label=chart.value_label, pad=0.015, aspect=40)
    bar.outline.set_visible(False)
    sure = Patch(facecolor="#7c7b78", edgecolor=INK, linewidth=1.0)
    unsure = Patch(facecolor="#b8b8b4", edgecolor="white", hatch="////", linewidth=0.0)
    words = [chart.outline_name, chart.veil_name]
    figure.legend([sure, unsure], words, loc="outside lower center", ncols=2)
    return figure


def _plane(axis: Axes, plane: Plane) -> AxesImage:
    """Steps of colour with pale lines between them, the veil over what has no data of its own."""
    levels = mpl.ticker.MaxNLocator(LEVELS).tick_values(plane.low, plane.high)
    norm = mpl.colors.BoundaryNorm(levels, 256, extend="both")
    extent = (*plane.x, *plane.y)
    place: dict[str, Any] = {"extent": extent, "origin": "lower"}
    values = np.maximum(plane.values, plane.low)  # a shut valve's noise is no colour of its own
    drawn = axis.imshow(
        values, PALETTES[plane.palette], norm, aspect="auto", interpolation="bilinear", **place
    )
    axis.contour(values, levels[1:], colors="white", linewidths=0.5, alpha=0.8, **place)
    cells = [Rectangle((x, y), width, height) for x, y, width, height in plane.veiled]
    style: dict[str, Any] = {"facecolor": VEIL, "edgecolor": HATCH, "hatch": "////"}
    axis.add_collection(PatchCollection(cells, linewidth=0.0, **style))
    if plane.points is not None:
        axis.plot(*plane.points.T, ".", color="white", ms=1.6, alpha=0.75, mew=0)
    ends = plane.outline.reshape(-1, 2, 2)
    axis.add_collection(LineCollection(list(ends), colors=INK, linewidths=1.0, capstyle="round"))
    axis.set_title(plane.title)
    return drawn


def _panels(chart: Chart) -> Figure:
    shape = len(chart.panels), max(len(row) for row in chart.panels)
    heights = [row[0].height for row in chart.panels]
    wide, high = chart.size_in
    figure = Figure(figsize=(max(6.0, wide * shape[1]), high * sum(heights) + 0.6))
    axes = figure.subplots(
        *shape,
        squeeze=False,
        sharex="col" if chart.is_timed else False,
        sharey=chart.common,
        height_ratios=heights,
    )
    for r, row in enumerate(chart.panels):
        for c, axis in enumerate(axes[r]):
            if c >= len(row):
                axis.remove()
                continue
            _panel(axis, row[c], chart)
            if not chart.is_timed or r + 1 == shape[0]:
                axis.set_xlabel(row[c].x_label)
            if c == 0 or chart.common == "none" or row[c].y_label != row[0].y_label:
                axis.set_ylabel(row[c].y_label)
    _legend(figure, [a for a in axes.ravel() if a.figure is not None])
    figure.align_ylabels()
    return figure


def _panel(axis: Axes, panel: Panel, chart: Chart) -> None:
    for shade in panel.shades:
        axis.axvspan(shade.low, shade.high, color=shade.colour, lw=0, zorder=0, label=shade.name)
    if panel.band:
        axis.axhspan(-panel.band, panel.band, color=PALE, lw=0, zorder=0, label=chart.band_name)
    if panel.has_zero:
        axis.axhline(0.0, color=GREY, lw=0.6, zorder=0.5)
    for strip in panel.strips:
        axis.fill_between(
            strip.x, strip.low, strip.high, color=strip.colour, alpha=0.2, lw=0, label=strip.name
        )
    for line in panel.lines:
        (drawn,) = axis.plot(*broken(line.x, line.y), color=line.colour, lw=line.width)
        drawn.set(linestyle=(0, (5, 3)) if line.is_dashed else "-", label=line.name)
    for k, points in enumerate(panel.points):
        _points(axis, points, k)
    for remark in panel.remarks:
        _remark(axis, remark)
    if panel.ticks:
        axis.set_xticks(range(len(panel.ticks)), panel.ticks)
        axis.set_xlim(-0.5, len(panel.ticks) - 0.5)
    if panel.limit:
        axis.set_ylim(-panel.limit, panel.limit)
    axis.set_title(panel.title, fontsize=9)


def _points(axis: Axes, points: Dots, k: int) -> None:
    axis.errorbar(
        points.x, points.y, points.error, color=points.colour, ms=3.5,
        elinewidth=1.0, capsize=1.5, lw=0.7, ls="-" if points.is_joined else "",
        marker="o" if points.marker == "c" else points.marker,
        mfc="white" if points.marker == "c" else points.colour,
        label=points.name if points.error is None else f"{points.name}, mean ± 95 %",
    )  # fmt: skip
    if not points.note:
        return
    place: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points"}
    words, at = f"{points.name}: {points.note}", (8, -5 - 12 * k)
    axis.annotate(words, (0.0, 1.0), at, color=points.colour, va="top", fontsize=8.5, **place)


def _remark(axis: Axes, remark: Remark) -> None:
    place: dict[str, Any] = {"transform": axis.get_xaxis_transform(), "fontsize": 8}
    colour = remark.colour or INK
    if remark.y is not None:
        style: dict[str, Any] = {"textcoords": "offset points", "annotation_clip": False}
        axis.annotate(remark.text, (remark.x, remark.y), (3, 0), va="center", fontsize=7.5, **style)
    elif remark.is_mark:
        axis.axvline(remark.x, color=colour, lw=1.6)
        axis.text(remark.x, 0.98, f" {remark.text}", color=colour, va="top", **place)
    else:
        axis.text(remark.x, 1.01, remark.text, color=colour, ha="center", va="bottom", **place)


def _legend(figure: Figure, axes: Sequence[Axes]) -> None:
    """Each name once, of all panels."""
    shown: dict[str, Any] = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        shown = dict(zip(labels, handles, strict=True)) | shown
    shown.pop("", None)
    if shown:
        columns = min(5, len(shown))
        figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=columns)


def broken(t: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What is drawn of a line: no spike is lost, and it is broken at NaN and at gaps of t.

    t (n,) and y (n,) in any units; the result in the same, NaN where it is broken.
    """
    step = np.diff(t)
    is_end = ~np.isfinite(y)
    is_end[1:] |= step > GAP * np.median(step) if len(t) > 2 else False
    runs = np.split(np.arange(len(t)), np.flatnonzero(is_end))
    known = [run[np.isfinite(y[run])] for run in runs]
    kept = [thin(t[run], y[run]) for run in known if len(run)] or [(t[:0], y[:0])]
    nothing = np.full(1, np.nan)
    joined = [np.concatenate([x for pair in kept for x in (pair[k], nothing)]) for k in (0, 1)]
    return joined[0][:-1], joined[1][:-1]


def _bars(chart: Bars) -> Figure:
    """Bars from above to below, their values behind them or inside, the limit dashed."""
    figure = Figure(figsize=(9.0, 0.9 + (0.28 if chart.is_log else 0.42) * len(chart.bars)))
    axis = figure.subplots()
    y = np.arange(len(chart.bars))
    start = WEAKEST if chart.is_log else 0.0
    values = [max(start, bar.value) for bar in chart.bars]
    colours = [BAR_COLOURS.get(bar.kind, BLUE) for bar in chart.bars]
    axis.barh(y, np.subtract(values, start), 0.62, left=start, color=colours)
    most = max(values)
    if np.isfinite(chart.limit):
        axis.axvline(chart.limit, color=INK, lw=1.1, ls=(0, (5, 3)))
        axis.annotate(chart.limit_name, (chart.limit, -0.72), (4, 0), va="center",
                      textcoords="offset points", fontsize=8)  # fmt: skip
        most = max(most, chart.limit)
    if chart.is_log:
        axis.set_xscale("log")
        axis.set_xlim(WEAKEST, 1.5 * max(2 * chart.limit, most))
        axis.xaxis.set_major_formatter(mpl.ticker.FormatStrFormatter("%g"))
        _afters(figure, axis, chart.bars)
    else:
        axis.set_xlim(0.0, 1.15 * most)
        for at, value in enumerate(values):
            _write_value(axis, at, value, INSIDE * most)
    axis.set_yticks(y, [bar.name for bar in chart.bars])
    axis.set_ylim(len(chart.bars) - 0.5, -1.0)
    axis.set_xlabel(chart.x_label)
    axis.tick_params(axis="y", length=0)
    axis.spines["left"].set_visible(False)
    return figure


def _write_value(axis: Axes, at: float, value: float, least: float) -> None:
    """The figure of a bar: inside where the bar is long enough, else behind it."""
    inside = value > least
    style: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": 9}
    style |= {"color": "white", "ha": "right", "fontweight": "bold"} if inside else {"ha": "left"}
    axis.annotate(f"{value:.2f} %", (value, at), (-6 if inside else 8, 0), **style)


def _afters(figure: Figure, axis: Axes, bars: Sequence[Bar]) -> None:
    """What is left of each, as a point; nothing where nothing was found."""
    if not any(bar.kind == "found" for bar in bars):
        return
    rest = [(max(WEAKEST, bar.after), y) for y, bar in enumerate(bars) if bar.after is not None]
    style: dict[str, Any] = {"ls": "", "marker": "s", "ms": 4.5, "color": BLUE}
    x, y = np.array(rest).T
    points = axis.plot(x, y, clip_on=False, label="after", **style)
    handles = [
        Patch(color=BAR_COLOURS["found"], label="before: now part of the model"),
        Patch(color=BAR_COLOURS["rival"], label="before"),
        *points,
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
