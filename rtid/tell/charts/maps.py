"""Fig. 5: the learned flow over the u-dp plane, and slices through it with their 95 % band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from rtid.compare.tables import AnyMap
from rtid.estimator.flowmap import VALID, EdgeMap, FlowMap
from rtid.plain import FloatArray
from rtid.tell.colours import BLUE, INK
from rtid.tell.stills import STYLE, label_outer, panels
from rtid.units import LPM, MPA, Z95

LATTICE = 160  # points per axis of a contour
SLICES = 5
VEIL, HATCH = (1.0, 1.0, 1.0, 0.35), (1.0, 1.0, 1.0, 0.75)
DOT: dict[str, Any] = {"marker": "o", "ms": 2.8, "mfc": "white", "mec": INK, "mew": 0.6}


def maps(flowmap: FlowMap) -> Figure:
    """Q in L/min as filled contours, one scale for all edges; hatched where a cell is not valid."""
    with mpl.rc_context(STYLE):
        figure, axes = panels(len(flowmap.edges))
        levels = _levels(flowmap)
        for axis, edge in zip(axes, flowmap.edges, strict=True):
            drawn = _contour(axis, edge, levels)
            axis.set_title(edge.name)
        label_outer(axes, "opening command w in V", "pressure drop in MPa")
        bar = figure.colorbar(drawn, ax=axes, label="flow in L/min", pad=0.015, aspect=40)
        bar.outline.set_visible(False)
        sure = Patch(facecolor="#7c7b78", edgecolor=INK, linewidth=1.0)
        unsure = Patch(facecolor="#b8b8b4", edgecolor="white", hatch="////", linewidth=0.0)
        words = ["valid", "not valid: from the orifice law"]
        figure.legend([sure, unsure], words, loc="outside lower center", ncols=2)
    return figure


def _levels(flowmap: FlowMap) -> FloatArray:
    """Round levels up to the largest flow at a valid cell."""
    largest = max((np.nan_to_num(edge.q_max_m3s) for edge in flowmap.edges), default=0.0) * LPM
    return np.asarray(mpl.ticker.MaxNLocator(12).tick_values(0.0, 1.25 * max(largest, 1e-3)))


def _contour(axis: Axes, edge: EdgeMap, levels: FloatArray) -> mpl.contour.QuadContourSet:
    u, p = edge.grid.u_v, edge.grid.dp_pa
    w, dp = np.linspace(u[0], u[-1], LATTICE), np.linspace(p[0], p[-1], LATTICE)
    q = edge.flow(w[None, :], dp[:, None]) * LPM
    q[np.abs(q) < 0.005 * levels[-1]] = 1e-9  # a shut valve's noise has no contour
    drawn = axis.contourf(w, dp * MPA, q, levels, cmap="cividis", extend="both")
    axis.contour(w, dp * MPA, q, levels[1:], colors="white", linewidths=0.5, alpha=0.8)
    _veil(axis, edge)
    _outline(axis, edge)
    return drawn


def _veil(axis: Axes, edge: EdgeMap) -> None:
    """Pale and hatched wherever a cell does not stand on its own data."""
    u, p = edge.grid.u_v, edge.grid.dp_pa * MPA
    cells = [
        Rectangle((u[i], p[j]), u[i + 1] - u[i], p[j + 1] - p[j])
        for i, j in np.argwhere(edge.status != VALID)
    ]
    style: dict[str, Any] = {"facecolor": VEIL, "edgecolor": HATCH, "hatch": "////"}
    axis.add_collection(PatchCollection(cells, linewidth=0.0, **style))


def _outline(axis: Axes, edge: EdgeMap) -> None:
    """The border between valid cells and others."""
    u, p, valid = edge.grid.u_v, edge.grid.dp_pa * MPA, edge.status == VALID
    framed = np.pad(valid, 1)
    for i, j in np.argwhere(framed[1:, 1:-1] != framed[:-1, 1:-1]):
        axis.plot([u[i], u[i]], p[j : j + 2], color=INK, lw=1.0, solid_capstyle="round")
    for i, j in np.argwhere(framed[1:-1, 1:] != framed[1:-1, :-1]):
        axis.plot(u[i : i + 2], [p[j], p[j]], color=INK, lw=1.0, solid_capstyle="round")


def slices(
    flowmap: FlowMap,
    reference: AnyMap | None = None,
    u_v: Sequence[float] | None = None,
    reference_name: str = "reference",
) -> Figure:
    """Q(dp) at fixed commands with the 95 % band, beside a reference; dashed where not valid.

    u_v: the commands; evenly spread over the valid range of each edge if not given.
    """
    with mpl.rc_context(STYLE):
        figure, axes = panels(len(flowmap.edges))
        for axis, edge in zip(axes, flowmap.edges, strict=True):
            chosen = _commands(edge) if u_v is None else np.asarray(u_v, float)
            for w_v in chosen:
                _slice(axis, edge, float(w_v))
                if reference is not None:
                    _reference(axis, edge, float(w_v), reference)
            axis.set_title(edge.name)
        axes[0].set_ylim(bottom=0.0)
        label_outer(axes, "pressure drop in MPa", "flow in L/min")
        _slice_legend(figure, reference_name if reference is not None else "")
    return figure


def _commands(edge: EdgeMap) -> FloatArray:
    """Centres of blocks, evenly spread over those that are valid somewhere and pass a flow."""
    u = edge.grid.u_v
    centre = 0.5 * (u[1:] + u[:-1])
    some = np.nonzero((edge.status == VALID).any(axis=1))[0]
    flow = np.array([edge.theta[i, edge.status[i] == VALID, 0].mean() for i in some])
    some = some[flow > 0.02 * flow.max(initial=0.0)] if len(some) else some
    if len(some) == 0:
        return centre[:: max(1, len(centre) // SLICES)]
    pick = np.unique(np.round(np.linspace(0, len(some) - 1, SLICES)).astype(int))
    return centre[some[pick]]


def _slice(axis: Axes, edge: EdgeMap, w_v: float) -> None:
    p = edge.grid.dp_pa
    dp = np.linspace(max(p[0], 0.0), p[-1], 300)
    q, sd = edge.flow(w_v, dp) * LPM, edge.sd(w_v, dp) * LPM
    valid = edge.status_at(w_v, dp) == VALID
    axis.fill_between(dp * MPA, q - Z95 * sd, q + Z95 * sd, color=BLUE, alpha=0.2, lw=0)
    axis.plot(dp * MPA, q, color=BLUE, lw=0.9, ls=(0, (4, 3)))
    axis.plot(dp * MPA, np.where(valid, q, np.nan), color=BLUE, lw=1.8)
    axis.annotate(
        f"{w_v:.3g} V",
        (dp[-1] * MPA, q[-1]),
        xytext=(3, 0),
        textcoords="offset points",
        va="center",
        fontsize=7.5,
        color=INK,
        annotation_clip=False,
    )


def _reference(axis: Axes, edge: EdgeMap, w_v: float, reference: AnyMap) -> None:
    p = edge.grid.dp_pa
    dp = np.linspace(max(p[0], 0.0), p[-1], 25)
    q = reference.flow(edge.name, np.full(len(dp), w_v), dp) * LPM
    axis.plot(dp * MPA, q, ls="", **DOT)


def _slice_legend(figure: Figure, reference_name: str) -> None:
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=BLUE, lw=1.8, label="learned, valid"),
        Line2D([], [], color=BLUE, lw=0.9, ls=(0, (4, 3)), label="extrapolated"),
        Patch(color=BLUE, alpha=0.2, lw=0, label="95 % band"),
    ]
    if reference_name:
        handles.append(Line2D([], [], ls="", label=reference_name, **DOT))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
