"""Is what is left noise: correlations of the innovations with their 95 % bands, and the CUSUM."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtid.colours import BLUE, GREY, HELD_OUT, INK, ORANGE, SEEN
from rtid.compare import Correlation, Cusum
from rtid.pictures.style import STYLE, thin

BAND, FEEDBACK = "#cfe3f0", "#f3f3f1"


def correlogram(found: Sequence[Correlation]) -> Figure:
    """One row of panels per chamber: with itself, then with each input."""
    chambers = list(dict.fromkeys(c.chamber for c in found))
    signals = list(dict.fromkeys(c.signal for c in found))
    with mpl.rc_context(STYLE):
        shape = max(1, len(chambers)), max(1, len(signals))
        figure = Figure(figsize=(max(6.0, 3.6 * shape[1]), 2.5 * shape[0] + 0.5))
        axes = figure.subplots(*shape, squeeze=False)
        for one in found:
            axis = axes[chambers.index(one.chamber), signals.index(one.signal)]
            _lags(axis, one)
        for axis in axes[-1]:
            axis.set_xlabel("lag in ms")
        for axis in axes[:, 0]:
            axis.set_ylabel("correlation")
        handles, labels = axes[0, -1].get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def _lags(axis: Axes, c: Correlation) -> None:
    ms = c.lags_s * 1e3
    inside = np.abs(c.value) <= c.band
    axis.fill_between(ms, -c.band, c.band, color=BAND, lw=0, label="95 % band of no relation")
    axis.axhline(0.0, color=GREY, lw=0.6)
    axis.plot(ms, c.value, color=BLUE, lw=0.8, label="correlation")
    out = np.where(inside, np.nan, c.value)
    axis.plot(ms, out, ls="", marker=".", ms=3.0, color=ORANGE, label="outside the band")
    if not c.itself:
        axis.axvline(0.0, color=GREY, lw=0.6)
        axis.axvspan(ms[0], 0.0, facecolor=FEEDBACK, lw=0, zorder=0)
        place: dict[str, Any] = {
            "transform": axis.transAxes,
            "fontsize": 7.5,
            "va": "top",
            "color": INK,
        }
        axis.text(0.02, 0.98, "feedback", ha="left", **place)
        axis.text(0.98, 0.98, f"{c.signal} comes first", ha="right", **place)
    most = 1.35 * max(np.abs(c.value).max(), c.band.max())
    axis.set_ylim(-most, most)
    axis.set_xlim(ms[0], ms[-1])
    axis.xaxis.set_major_locator(mpl.ticker.MaxNLocator(5))
    axis.yaxis.set_major_locator(mpl.ticker.MaxNLocator(5))
    what = "with itself" if c.itself else f"with {c.signal}"
    axis.set_title(f"chamber {c.chamber} {what}: {100 * c.outside:.0f} % outside", fontsize=8.5)


def cusum(parts: Mapping[str, Sequence[Cusum]]) -> Figure:
    """Cumulative sums with their boundaries, one row per chamber; each part starts from zero."""
    chambers = list(dict.fromkeys(c.chamber for found in parts.values() for c in found))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 2.5 * max(1, len(chambers)) + 0.5))
        axes = figure.subplots(max(1, len(chambers)), 1, sharex=True, squeeze=False)[:, 0]
        for k, (title, found) in enumerate(parts.items()):
            for one in found:
                _sum(axes[chambers.index(one.chamber)], one, title, SEEN if k == 0 else HELD_OUT)
        for axis, chamber in zip(axes, chambers, strict=False):
            axis.set_title(f"chamber {chamber}")
            axis.set_ylabel("sum of recursive\nresiduals")
        axes[-1].set_xlabel("time in s")
        handles, labels = axes[0].get_legend_handles_labels()
        shown = dict(zip(labels, handles, strict=True))
        figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=len(shown))
    return figure


def _sum(axis: Axes, c: Cusum, title: str, colour: str) -> None:
    if not len(c.t_s):
        return
    axis.axvspan(c.t_s[0], c.t_s[-1], color=colour, lw=0, zorder=0, label=title)
    axis.axhline(0.0, color=GREY, lw=0.5)
    for sign in (1.0, -1.0):
        ends = [0, len(c.t_s) - 1]
        line: dict[str, Any] = {"color": INK, "lw": 1.0, "ls": (0, (5, 3)), "label": "5 % boundary"}
        axis.plot(c.t_s[ends], sign * c.boundary[ends], **line)
    axis.plot(*thin(c.t_s, c.value), color=BLUE, lw=1.0, label="cumulative sum")
    if c.crosses_s is not None and c.change_s is not None:
        axis.axvline(c.crosses_s, color=ORANGE, lw=1.0, ls=":", label="leaves the boundary")
        axis.axvline(c.change_s, color=ORANGE, lw=1.6, label="begins to fail")
        place: dict[str, Any] = {
            "transform": axis.get_xaxis_transform(),
            "va": "top",
            "fontsize": 8,
        }
        axis.text(c.change_s, 0.98, f" {c.change_s:.1f} s", color=ORANGE, **place)
