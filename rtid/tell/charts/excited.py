"""What motions will tell of each block: the map's standard error over the plane."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from rtid.excite.prediction import Prediction
from rtid.model import Edge, Machine
from rtid.tell.axes import common_labels
from rtid.tell.colours import GREY, INK
from rtid.tell.stills import STYLE, label_outer, panels
from rtid.units import MPA

PERCENT = (0.02, 2.0)  # ends of the scale


def predicted(model: Machine, motions: tuple[Prediction, ...]) -> Figure:
    """One row per edge, one column for each of two motions; a dot marks a valid block."""
    with mpl.rc_context(STYLE):
        figure, axes = panels(2 * len(model.edges))
        for k, axis in enumerate(axes):
            edge, motion = k // 2, motions[k % 2]
            mesh = _sds(axis, model.edges[edge], edge, motion)
            axis.set_title(f"{model.edges[edge].name}: {motion.name}")
        label_outer(axes, *common_labels(model))
        bar = figure.colorbar(mesh, ax=axes, shrink=0.6, aspect=40)
        bar.set_label("predicted standard error of the map, % of the largest flow; dot: valid")
    return figure


def _sds(axis: Axes, edge: Edge, number: int, motion: Prediction) -> QuadMesh:
    u, p = edge.grid.u_v, edge.grid.dp_pa * MPA
    sd = np.full(edge.grid.shape, np.nan)
    for b in motion.blocks:
        if b.edge == number:
            sd[b.i, b.j] = 100.0 * b.sd
            if b.valid:
                middle = 0.5 * (u[b.i] + u[b.i + 1]), 0.5 * (p[b.j] + p[b.j + 1])
                axis.plot(*middle, ".", color=INK, ms=2.5, mew=0)
    norm = mpl.colors.LogNorm(*PERCENT, clip=True)
    mesh = axis.pcolormesh(u, p, sd.T, cmap="viridis_r", norm=norm, edgecolors=GREY, linewidth=0.2)
    axis.set_xlim(u[0], u[-1])
    axis.set_ylim(p[0], p[-1])
    return mesh
