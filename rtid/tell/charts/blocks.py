"""The u-dp plane of every valve, block by block: colour, number, hatching with the reason.

Blocks are drawn at equal size, with their borders as ticks, so that a number fits in each; on a
small page the browser turns the numbers, or leaves them out (`static/plots.js`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.layouts import column
from bokeh.models import ColumnDataSource, FixedTicker, HoverTool, Range1d, TapTool, UIElement
from bokeh.palettes import Blues9, interp_palette
from bokeh.plotting import figure

from rtid.compare import BlockRow
from rtid.compare.tables import CAUSES, cause_of
from rtid.model import NONE, Axes, Edge, Machine
from rtid.tell.axes import axes_of, heading, labels, place, second, small_flow
from rtid.tell.charts.theme import FIGURES_TAG, LIT, NARROWEST_PX, beside, plot
from rtid.tell.colours import GREY
from rtid.tell.live import YELLOWS
from rtid.units import Z95, flow_name, lpm

Key = tuple[str, int, int]
HATCHES = dict(zip(CAUSES, (" ", ".", "/", "\\", "x", "+"), strict=True))
STATUS_COLOURS = {
    "valid": "#9ecae1", "learning": "#f6e3b4", "stale": "#d9d9d9", "invalid": "#e6a98c",
}  # fmt: skip
LARGEST = 0.98  # quantile of the blocks' residuals at which their scale ends
EMPTY, OTHER = "rgba(128, 128, 128, 0.10)", "rgba(128, 128, 128, 0.25)"
DARK_FROM = 0.55  # of a scale: figures are white from here on
MOST_TICKS = 9


@dataclass(frozen=True)
class Quantity:
    """What the colour of a block tells: its scale is fixed and stated.

    low, high: ends of the scale; is_log: decades.
    """

    name: str
    unit: str
    value: Callable[[BlockRow], float]
    low: float
    high: float
    palette: Sequence[str]
    is_log: bool = False
    digits: str = ".2g"

    def place(self, row: BlockRow) -> float:
        """Where a block is on the scale, 0 to 1; NaN where it has no value."""
        value = self.value(row)
        if not np.isfinite(value) or (self.is_log and value <= 0):
            return float("nan")
        low, high = self.low, self.high
        if self.is_log:
            value, low, high = np.log10([value, low, high])
        return float(np.clip((value - low) / (high - low), 0.0, 1.0))

    def colour(self, row: BlockRow) -> str:
        """Of its place on the scale."""
        at = self.place(row)
        return self.palette[int(at * (len(self.palette) - 1))] if np.isfinite(at) else EMPTY

    def text(self, row: BlockRow) -> str:
        """The figure in the block."""
        value = self.value(row)
        if not np.isfinite(value):
            return ""
        if self.is_log and value >= 1000:
            return f"1e{int(np.log10(value))}" if value >= 1e4 else f"{value / 1e3:.0f}k"
        return f"{value:{self.digits}}".replace("0.", ".", 1 if value < 1 else 0)


BLUES = list(interp_palette(tuple(reversed(Blues9)), 256))[8:220]


def quantities(largest: float) -> dict[str, Quantity]:
    """Everything that the plane can show; largest: of the residual's scale, in `small_flow`."""
    small = small_flow()
    digits = ".0f" if small.name == "mL/min" else ".2g"
    return {
        q.name: q
        for q in (
            Quantity("residual", f"{small.name} rms", lambda b: b.residual_rms_m3s * small.factor,
                     0.0, largest, YELLOWS, digits=digits),
            Quantity("share of the residual", "%", lambda b: 100 * b.residual_share, 0.0, 20.0,
                     YELLOWS, digits=".1f"),
            Quantity("samples", "rows", lambda b: float(b.rows), 1.0, 1e4, BLUES, True, ".0f"),
            Quantity("condition number", "", lambda b: b.condition, 1.0, 1e8, YELLOWS, True,
                     ".0f"),
            Quantity("standard error", "% of the flow", _sd_share, 0.01, 10.0, YELLOWS, True),
            Quantity("status", "", lambda b: float("nan"), 0.0, 1.0, BLUES),
        )
    }  # fmt: skip


def _sd_share(block: BlockRow) -> float:
    flow = abs(block.flow_m3s)
    return 100 * block.sd_m3s / flow if flow > 0 else float("nan")


def quantities_of(blocks: Iterable[BlockRow]) -> dict[str, Quantity]:
    """The quantities, on a scale that holds nearly all residuals of these blocks."""
    values = [b.residual_rms_m3s for b in blocks if np.isfinite(b.residual_rms_m3s)]
    most = float(np.quantile(values, LARGEST)) if values else 0.0
    return quantities(_round_up(small_flow().factor * most))


def _round_up(value: float) -> float:
    """To 1, 2 or 5 times a power of ten."""
    if not np.isfinite(value) or value <= 0:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(m * decade for m in (1, 2, 5, 10) if m * decade >= value * 0.999))


class BlockPlots:
    """One plot per edge; a tap on a block is told to `on_block`."""

    def __init__(self, model: Machine, blocks: Sequence[BlockRow], on_block: Callable[[Key], None]):
        self._on_block = on_block
        self._sources: dict[str, ColumnDataSource] = {}
        self._lit: dict[str, ColumnDataSource] = {}
        self._shown: dict[str, list[BlockRow]] = {}
        self._axes = axes_of(model)
        plots = [self._plot(e, [b for b in blocks if b.edge == e.name]) for e in model.maps]
        pairs = [plots[k : k + 2] for k in range(0, len(plots), 2)]
        rows = [beside(*pair, stacked_below_px=NARROWEST_PX) for pair in pairs]
        self.root: UIElement = column(*rows, sizing_mode="stretch_both")

    def show(self, blocks: Sequence[BlockRow], quantity: Quantity) -> None:
        """Another quantity, part or revision."""
        for edge, source in self._sources.items():
            rows = [b for b in blocks if b.edge == edge]
            self._shown[edge] = rows
            source.data = _columns(rows, quantity, self._axes[edge])

    def light(self, keys: Mapping[Key, float] | Sequence[Key]) -> None:
        """Outline blocks."""
        for edge, source in self._lit.items():
            cells = [(i, j) for name, i, j in keys if name == edge]
            marked = {"x": [i + 0.5 for i, _ in cells], "y": [j + 0.5 for _, j in cells]}
            if marked != dict(source.data):  # a plane that does not change is not painted anew
                source.data = marked

    def _plot(self, edge: Edge, blocks: Sequence[BlockRow]) -> figure:
        used = [(b.i, b.j) for b in blocks] or [(0, 0)]
        (i0, j0), (i1, j1) = np.min(used, axis=0), np.max(used, axis=0)
        axes = self._axes[edge.name]
        source = ColumnDataSource(_columns([], next(iter(quantities(1.0).values())), axes))
        made = plot(
            x_range=Range1d(i0 - 0.1, i1 + 1.1), y_range=Range1d(j0 - 0.1, j1 + 1.1),
            title=f"{heading(edge, axes)}{'' if blocks else ', never open'}",
        )  # fmt: skip
        _ticks(made.xaxis[0], edge.grid.u_v, int(i0), int(i1) + 1)
        _ticks(made.yaxis[0], edge.grid.dp_pa * second(axes).factor, int(j0), int(j1) + 1)
        made.yaxis.visible = axes.over != NONE
        command, over = labels(axes)
        made.xaxis.axis_label, made.yaxis.axis_label = command, over.removeprefix("pressure ")
        made.grid.visible = False
        made.min_border_left = 46
        box: dict[str, Any] = {"width": 0.96, "height": 0.94, "source": source}
        cells = made.rect(
            "x", "y", fill_color="fill", line_color=None, hatch_pattern="hatch",
            hatch_color=GREY, hatch_alpha=0.55, hatch_weight=0.6, hatch_scale=7,
            nonselection_fill_alpha=1.0, nonselection_hatch_alpha=0.55, **box,
        )  # fmt: skip
        figures = made.text(
            "x", "y", "text", source=source, text_color="ink", text_align="center",
            text_baseline="middle", text_font_size="9px",
        )  # fmt: skip
        figures.nonselection_glyph, figures.glyph.tags = None, [FIGURES_TAG]
        lit = ColumnDataSource({"x": [], "y": []})
        made.rect(
            "x", "y", width=1.0, height=1.0, source=lit, fill_color=None, line_color=LIT,
            line_width=2.6,
        )  # fmt: skip
        made.add_tools(TapTool(renderers=[cells]), HoverTool(renderers=[cells], tooltips=TIP))
        source.selected.on_change(
            "indices", lambda _attr, _old, new, name=edge.name: self._tapped(name, new)
        )
        self._sources[edge.name], self._lit[edge.name] = source, lit
        return made

    def _tapped(self, edge: str, indices: Sequence[int]) -> None:
        if indices and indices[0] < len(self._shown.get(edge, [])):
            block = self._shown[edge][indices[0]]
            self._sources[edge].selected.indices = []
            self._on_block((edge, block.i, block.j))


TIP = """<div><b>@place</b><br>
residual @residual @unit rms, @share % of all<br>@rows rows in @dwell s<br>
flow @flow ± @sd @unit (95 %), condition @condition<br>@status @reason</div>"""


def _columns(blocks: Sequence[BlockRow], quantity: Quantity, axes: Axes) -> dict[str, list[Any]]:
    by_status = quantity.name == "status"
    fill = [
        STATUS_COLOURS.get(b.status, OTHER) if by_status else quantity.colour(b) for b in blocks
    ]
    dark = [not by_status and quantity.place(b) > DARK_FROM for b in blocks]
    return {
        "x": [b.i + 0.5 for b in blocks],
        "y": [b.j + 0.5 for b in blocks],
        "fill": fill,
        "hatch": [HATCHES[cause_of(b)] for b in blocks],
        "text": [b.status[:4] if by_status else quantity.text(b) for b in blocks],
        "ink": ["#ffffff" if d else "#22272b" for d in dark],
        "place": [place(axes, b.u_v, b.dp_pa) for b in blocks],
        "residual": [_told(b.residual_rms_m3s * lpm(), ".3g") for b in blocks],
        "unit": [flow_name()] * len(blocks),
        "share": [_told(100 * b.residual_share, ".2g") for b in blocks],
        "rows": [f"{b.rows}" for b in blocks],
        "dwell": [f"{b.dwell_s:.2f}" for b in blocks],
        "flow": [_told(b.flow_m3s * lpm(), ".3g") for b in blocks],
        "sd": [_told(Z95 * b.sd_m3s * lpm(), ".2g") for b in blocks],
        "condition": [_told(b.condition, ".1e") for b in blocks],
        "status": [b.status for b in blocks],
        "reason": [f"- {b.reason}" if b.reason else "" for b in blocks],
    }


def _told(value: float, digits: str) -> str:
    return f"{value:{digits}}" if np.isfinite(value) else "-"


def _ticks(axis: Any, borders: np.ndarray, first: int, last: int) -> None:
    at = list(range(first, last + 1, max(1, -(-(last - first) // MOST_TICKS))))
    axis.ticker = FixedTicker(ticks=at)
    axis.major_label_overrides = {k: f"{borders[k]:.3g}" for k in at}
