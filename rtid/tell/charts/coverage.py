"""Fig. 4: where the data lie in the u-dp plane, and what became of each block."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from rtid.estimator.flowmap import EdgeMap, FlowMap
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.tell.axes import common_labels, heading, second
from rtid.tell.charts.points import spread_points
from rtid.tell.colours import GREY, INK, LINE
from rtid.tell.stills import FILL, LABELS, STYLE, label_outer, panels

DOTS = 6000  # samples drawn per edge


def coverage(model: Machine, flowmap: FlowMap, chunk: FloatArray) -> Figure:
    """Blocks by status and the samples in them; chunk (n, 2 + signals), SI."""
    with mpl.rc_context(STYLE):
        figure, axes = panels(len(model.maps))
        for axis, edge, learned in zip(axes, model.maps, flowmap.edges, strict=True):
            _blocks(axis, learned, second(model.axes(edge)).factor)
            w_v, dp_pa = spread_points(model, edge, chunk, DOTS).T
            axis.plot(w_v, dp_pa, ".", color=INK, ms=1.8, alpha=0.45, mew=0)
            axis.set_title(heading(edge, model.axes(edge)))
        label_outer(axes, *common_labels(model))
        _legend(figure, flowmap)
    return figure


def _blocks(axis: Axes, edge: EdgeMap, factor: float) -> None:
    u, p = edge.grid.u_v, edge.grid.dp_pa * factor
    words = list(FILL)
    code = np.searchsorted(sorted(words), edge.status)
    fills = mpl.colors.ListedColormap([FILL[word] for word in sorted(words)])
    mesh = axis.pcolormesh(u, p, code.T, cmap=fills, edgecolors=LINE, linewidth=0.35)
    mesh.set_clim(0, len(words) - 1)
    axis.set_xlim(u[0], u[-1])
    axis.set_ylim(p[0], p[-1])


def _legend(figure: Figure, flowmap: FlowMap) -> None:
    present = {word for edge in flowmap.edges for word in np.unique(edge.status).tolist()}
    handles = [
        Patch(facecolor=colour, edgecolor=GREY, linewidth=0.5, label=LABELS[word])
        for word, colour in FILL.items()
        if word in present
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
