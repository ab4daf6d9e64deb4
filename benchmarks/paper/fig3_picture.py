"""Fig. 3 drawn: curves and crosses, a border with and without windows, the error over the plane."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.paper.function import U_MAX, X_MAX, true_value
from benchmarks.paper.surface import Estimate
from rtid.tell.colours import BLUE, GREEN, GREY, INK, LINE, ORANGE
from rtid.tell.stills import STYLE

CUTS = (0.5, 1.5, 2.5, 3.5)  # values of x of the curves
ZOOM_X, ZOOM_U = 1.5, (1.2, 1.8)
TAYLOR_SCALE, LAPPED_SCALE = 0.5, 3.0  # of the errors' colours, % of full scale


def draw(taylor: Estimate, lapped: Estimate) -> Figure:
    """All panels."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 6.6))
        (first, second), (third, fourth) = figure.subplots(2, 2)
        _curves(first, taylor)
        _zoom(second, taylor, lapped)
        for axis, estimate, scale, name in (
            (third, taylor, TAYLOR_SCALE, "Taylor blocks"),
            (fourth, lapped, LAPPED_SCALE, "lapped basis"),
        ):
            mesh = _error(axis, estimate, scale)
            axis.set_title(f"error, {name}, % of full scale")
            figure.colorbar(mesh, ax=axis, aspect=30, pad=0.02).outline.set_visible(False)
    return figure


def _curves(axis: Axes, taylor: Estimate) -> None:
    u, at = np.linspace(0, U_MAX, 400), np.linspace(0.1, U_MAX - 0.1, 25)
    for x in CUTS:
        axis.plot(u, true_value(u, x), color=INK, lw=1.0)
        axis.plot(at, taylor.published.flow(at, x), "x", color=BLUE, ms=5)
        axis.annotate(f"x = {x:g}", (u[-1], float(true_value(u[-1], x))), fontsize=7.5)
    axis.set(xlabel="u", ylabel="f(u, x)", title="true (lines) and estimated (crosses)")


def _zoom(axis: Axes, taylor: Estimate, lapped: Estimate) -> None:
    u = np.linspace(*ZOOM_U, 1201)
    x = np.full(len(u), ZOOM_X)
    raw = taylor.unwindowed(u, x)
    inner = [b for b in taylor.grid.u_v if ZOOM_U[0] < b < ZOOM_U[1]]
    raw[np.searchsorted(u, inner)] = np.nan
    for border in inner:
        axis.axvline(border, color=LINE, lw=0.7, zorder=0)
    axis.plot(u, true_value(u, x), color=INK, lw=0.9, label="true")
    axis.plot(u, raw, color=ORANGE, lw=1.4, label="no windows")
    axis.plot(u, taylor.published.flow(u, x), color=BLUE, lw=1.4, label="under windows")
    axis.plot(u, lapped.windowed(u, x), color=GREEN, lw=1.1, ls="--", label="lapped basis")
    axis.legend(loc="upper left")
    axis.set(xlabel="u", title=f"at the end of the dead band, x = {ZOOM_X:g}")


def _error(axis: Axes, estimate: Estimate, scale: float) -> mpl.collections.QuadMesh:
    u, x = np.linspace(0, U_MAX, 301), np.linspace(0, X_MAX, 161)
    us, xs = np.meshgrid(u, x)
    miss = 100 * (estimate.published.flow(us, xs) - true_value(us, xs))
    miss /= float(true_value(U_MAX, X_MAX))
    mesh = axis.pcolormesh(u, x, miss, cmap="RdBu_r", vmin=-scale, vmax=scale, rasterized=True)
    for border in estimate.grid.u_v:
        axis.axvline(border, color=GREY, lw=0.4)
    for border in estimate.grid.dp_pa:
        axis.axhline(border, color=GREY, lw=0.4)
    axis.set(xlabel="u", ylabel="x")
    return mesh
