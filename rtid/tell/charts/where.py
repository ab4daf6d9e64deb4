"""Where the model fails: residual per block over the u-dp plane, hatched by what a block lacks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from rtid.compare import BlockRow
from rtid.compare.tables import CAUSES, cause_of
from rtid.model import Edge, Machine
from rtid.tell.axes import common_labels, heading, second
from rtid.tell.colours import GREY, INK, LINE
from rtid.tell.stills import STYLE, label_outer, panels
from rtid.units import flow_name, lpm

HATCHES = dict(zip(CAUSES, ("", "....", "////", "\\\\\\\\", "xxxx", "++++"), strict=True))
EMPTY = "#f4f4f2"


def residual_map(model: Machine, rows: Sequence[BlockRow]) -> Figure:
    """Residual rms in L/min of every visited block, one scale for all edges.

    rows: `compare.block_rows`.  White on the scale is none, dark is much; blocks without a residual
    of their own are pale.
    """
    with mpl.rc_context(STYLE):
        figure, axes = panels(len(model.maps), width=10.0, height=3.4)
        values = np.array([row.residual_rms_m3s * lpm() for row in rows])
        top = float(np.nanquantile(values, 0.98)) if np.isfinite(values).any() else 1.0
        norm, colours = mpl.colors.Normalize(0.0, max(top, 1e-9)), mpl.colormaps["YlOrBr"]
        for axis, edge in zip(axes, model.maps, strict=True):
            of_edge = [row for row in rows if row.edge == edge.name]
            _blocks(axis, edge, of_edge, norm, colours, second(model.axes(edge)).factor)
            axis.set_title(heading(edge, model.axes(edge)))
        label_outer(axes, *common_labels(model))
        scale = mpl.cm.ScalarMappable(norm, colours)
        bar = figure.colorbar(
            scale, ax=axes, label=f"residual, {flow_name()} rms", pad=0.015, aspect=40, extend="max"
        )
        bar.outline.set_visible(False)
        _legend(figure, rows)
    return figure


def _blocks(
    axis: Axes,
    edge: Edge,
    rows: Sequence[BlockRow],
    norm: mpl.colors.Normalize,
    colours: mpl.colors.Colormap,
    factor: float,
) -> None:
    u, p = edge.grid.u_v, edge.grid.dp_pa * factor
    axis.set_xlim(u[0], u[-1])
    axis.set_ylim(p[0], p[-1])
    axis.set_facecolor("white")
    for row in rows:
        known = np.isfinite(row.residual_rms_m3s)
        face = colours(norm(row.residual_rms_m3s * lpm())) if known else EMPTY
        axis.add_patch(Rectangle(*_box(row, factor), facecolor=face, edgecolor=LINE, linewidth=0.4))
    for cause, hatch in HATCHES.items():
        boxes = [Rectangle(*_box(row, factor)) for row in rows if cause_of(row) == cause]
        if boxes and hatch:
            style = PatchCollection(boxes, facecolor="none", edgecolor=GREY, linewidth=0.0)
            style.set_hatch(hatch)
            axis.add_collection(style)
    worst = max(rows, key=lambda row: row.residual_share, default=None)
    if worst is not None and worst.residual_share > 0:
        (x, y), width, height = _box(worst, factor)
        frame = Rectangle((x, y), width, height, facecolor="none", edgecolor=INK, linewidth=1.4)
        axis.add_patch(frame)
        text, at = f"{100 * worst.residual_share:.0f} %", (x + width, y + height)
        shift: dict[str, Any] = {"xytext": (2, 2), "textcoords": "offset points"}
        axis.annotate(text, at, fontsize=8, color=INK, **shift)


def _box(row: BlockRow, factor: float) -> tuple[tuple[float, float], float, float]:
    low = row.dp_pa[0] * factor
    return (row.u_v[0], low), row.u_v[1] - row.u_v[0], row.dp_pa[1] * factor - low


def _legend(figure: Figure, rows: Sequence[BlockRow]) -> None:
    present = {cause_of(row) for row in rows}
    handles = [
        Patch(facecolor="white", edgecolor=GREY, hatch=hatch, linewidth=0.5, label=cause)
        for cause, hatch in HATCHES.items()
        if cause in present
    ]
    if any(not np.isfinite(row.residual_rms_m3s) for row in rows):
        pale = Patch(facecolor=EMPTY, edgecolor=LINE, linewidth=0.4, label="not in this part")
        handles.append(pale)
    handles.append(Patch(facecolor="white", edgecolor=LINE, linewidth=0.4, label="white: no data"))
    label = "largest share of the residual"
    handles.append(Patch(facecolor="white", edgecolor=INK, linewidth=1.4, label=label))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(5, len(handles)))
