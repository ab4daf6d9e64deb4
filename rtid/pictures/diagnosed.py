"""A diagnosis in pictures: the error falls, the flows before and after, what is left, the ranking.

All of them take what `rtid.diagnose` returns; "before" is the model as it is, "after" the model
with everything that was found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from rtid.colours import BLUE, GREY, HELD_OUT, INK, LINE, ORANGE, PALE, SEEN, UNITS
from rtid.compare import Dependence
from rtid.diagnose.residual import Residual
from rtid.pictures.style import STYLE, thin
from rtid.units import LPM

BEFORE, AFTER = (ORANGE, "o"), (BLUE, "s")  # colour and marker
POINTS = 500  # pairs of least and largest value that a line shows
GAP = 5.0  # steps: no line across a longer one
Z95 = 1.96
SHOWN = 0.96  # of the error bars lie wholly within the scale
INSIDE = 0.25  # of the axis: a longer bar has its figure inside
WEAKEST = 0.1  # standard deviations at the left end of the ranking


def errors(steps: Sequence[tuple[str, float]], floor: float, part: str) -> Figure:
    """Error of a part behind each step, by name, in per cent of the rms flow, and the floor."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 0.9 + 0.42 * len(steps)))
        axis = figure.subplots()
        colours = [ORANGE if k == 0 and len(steps) > 1 else BLUE for k in range(len(steps))]
        y = np.arange(len(steps))
        values = [value for _, value in steps]
        axis.barh(y, values, 0.62, color=colours)
        for at, value in enumerate(values):
            _write_value(axis, at, value, INSIDE * max([floor, *values]))
        axis.axvline(floor, color=INK, lw=1.1, ls=(0, (5, 3)))
        axis.annotate(f"sensors' floor {floor:.2f} %", (floor, -0.62), (4, 0), va="center",
                      textcoords="offset points", fontsize=8)  # fmt: skip
        axis.set_yticks(y, [name for name, _ in steps])
        axis.set_ylim(len(steps) - 0.5, -0.85)
        axis.set_xlim(0.0, 1.15 * max([floor, *values]))
        axis.set_xlabel(f"error on the {part} in % of the rms flow")
        axis.tick_params(axis="y", length=0)
        axis.spines["left"].set_visible(False)
    return figure


def _write_value(axis: Axes, at: float, value: float, least: float) -> None:
    """The figure of a bar: inside where the bar is long enough, else behind it."""
    inside = value > least
    style: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": 9}
    style |= {"color": "white", "ha": "right", "fontweight": "bold"} if inside else {"ha": "left"}
    axis.annotate(f"{value:.2f} %", (value, at), (-6 if inside else 8, 0), **style)


def flows(chambers: Sequence[str], models: Mapping[str, Sequence[Residual]]) -> Figure:
    """Measured and modelled flow of every chamber, residual below; one column per model, by title.

    models: identification and held-out part of each.  A row has one scale.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.5, 2.7 * len(chambers) + 0.5))
        axes = figure.subplots(
            2 * len(chambers),
            len(models),
            sharex=True,
            sharey="row",
            squeeze=False,
            height_ratios=[1.7, 1.0] * len(chambers),
        )
        for k, (title, parts) in enumerate(models.items()):
            for c in range(len(chambers)):
                _flow(axes[2 * c, k], parts, c)
                _left(axes[2 * c + 1, k], parts, c)
            axes[0, k].set_title(title, fontweight="bold")
            axes[-1, k].set_xlabel("time in s")
        for c, name in enumerate(chambers):
            axes[2 * c, 0].set_ylabel(f"chamber {name}\nflow in L/min")
            axes[2 * c + 1, 0].set_ylabel("residual\nin L/min")
        _flow_legend(figure, axes)
        figure.align_ylabels()
    return figure


def _flow(axis: Axes, parts: Sequence[Residual], c: int) -> None:
    _shade(axis, parts)
    for k, part in enumerate(parts):
        names = ("measured, s A v", "modelled") if k == 0 else ("", "")
        modelled = part.measured - part.left
        axis.plot(*_line(part.t_s, part.measured[:, c]), color=INK, lw=1.5, label=names[0])
        axis.plot(*_line(part.t_s, modelled[:, c]), color=ORANGE, lw=0.8, label=names[1])


def _left(axis: Axes, parts: Sequence[Residual], c: int) -> None:
    _shade(axis, parts)
    axis.axhline(0.0, color=GREY, lw=0.5)
    for k, part in enumerate(parts):
        label = "residual" if k == 0 else ""
        axis.plot(*_line(part.t_s, part.left[:, c]), color=BLUE, lw=0.6, label=label)
        if len(part.t_s):
            text = f"rms {LPM * float(np.sqrt(np.mean(part.left[:, c] ** 2))):.3g} L/min"
            middle = 0.5 * (part.t_s[0] + part.t_s[-1])
            place: dict[str, Any] = {"transform": axis.get_xaxis_transform(), "fontsize": 7.5}
            axis.text(middle, 1.01, text, ha="center", va="bottom", **place)


def _shade(axis: Axes, parts: Sequence[Residual]) -> None:
    for part, colour in zip(parts, (SEEN, HELD_OUT), strict=True):
        if len(part.t_s):
            axis.axvspan(part.t_s[0], part.t_s[-1], color=colour, lw=0, zorder=0)


def _line(t_s: np.ndarray, q_m3s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The line in L/min, thinned, broken where samples are missing."""
    gaps = t_s[1:][np.diff(t_s) > GAP * np.median(np.diff(t_s))] if len(t_s) > 2 else t_s[:0]
    t, q = thin(t_s, q_m3s * LPM, POINTS)
    at = np.searchsorted(t, gaps)
    return np.insert(t, at, np.nan), np.insert(q, at, np.nan)


def _flow_legend(figure: Figure, axes: np.ndarray) -> None:
    lines, _ = axes[0, 0].get_legend_handles_labels()
    left, _ = axes[1, 0].get_legend_handles_labels()
    shades = [
        Patch(facecolor=SEEN, edgecolor=LINE, linewidth=0.4, label="identification"),
        Patch(facecolor=HELD_OUT, edgecolor=LINE, linewidth=0.4, label="held out"),
    ]
    figure.legend(handles=[*lines, *left, *shades], loc="outside lower center", ncols=5)


def dependences(
    chambers: Sequence[str], models: Mapping[str, Sequence[Dependence]], floor_m3s: float
) -> Figure:
    """Mean residual over bins of each signal: one row per signal, one column per chamber.

    models: the same signals for the model before and, where there is one, after.
    """
    signals = [found.signal for found in next(iter(models.values()))]
    with mpl.rc_context(STYLE):
        shape = len(signals), len(chambers)
        figure = Figure(figsize=(10.5, 1.75 * shape[0] + 0.5))
        axes = figure.subplots(*shape, sharey=True, squeeze=False)
        for (title, found), look in zip(models.items(), (BEFORE, AFTER), strict=False):
            for r, dependence in enumerate(found):
                for c in range(len(chambers)):
                    _bins(axes[r, c], dependence, c, title, look)
        for axis in axes.ravel():
            axis.axhspan(-floor_m3s * LPM, floor_m3s * LPM, color=PALE, lw=0, zorder=0)
            axis.axhline(0.0, color=GREY, lw=0.5, zorder=0.5)
        _explained(axes, list(models.values()))
        axes[0, 0].set_ylim(*_scale(models))
        for axis, name in zip(axes[0], chambers, strict=True):
            axis.set_title(f"chamber {name}", fontweight="bold")
        for axis in axes[:, 0]:
            axis.set_ylabel("residual in L/min")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        handles.append(Patch(facecolor=PALE))
        labels.append("± rms of the sensors' noise")
        figure.legend(handles, labels, ncols=3, loc="outside lower center")
    return figure


def _scale(models: Mapping[str, Sequence[Dependence]]) -> tuple[float, float]:
    """One scale for all panels, with every mean; bins of few rows may have longer error bars."""
    found = [d for one in models.values() for d in one]
    means = np.concatenate([np.abs(d.mean_m3s).ravel() for d in found])
    ends = np.concatenate([(np.abs(d.mean_m3s) + Z95 * d.error_m3s).ravel() for d in found])
    most = max(1.1 * means.max(), 1.4 * np.quantile(ends, SHOWN)) if len(means) else 1.0
    return -LPM * most, LPM * most


def _explained(axes: np.ndarray, models: Sequence[Sequence[Dependence]]) -> None:
    """Write into each panel what share of the residual's variance its bins explain."""
    for (r, c), axis in np.ndenumerate(axes):
        shares = "explains " + " → ".join(
            f"{100 * found[r].explained[c]:.0f} %" for found in models
        )
        axis.text(0.995, 0.97, shares, transform=axis.transAxes, ha="right", va="top", fontsize=8)


def _bins(axis: Axes, found: Dependence, c: int, title: str, look: tuple[str, str]) -> None:
    unit, factor = UNITS.get(found.unit, (found.unit, 1.0))
    mean, error = found.mean_m3s[:, c] * LPM, Z95 * found.error_m3s[:, c] * LPM
    colour, marker = look
    style: dict[str, Any] = {"color": colour, "marker": marker, "ms": 3.2, "elinewidth": 0.9}
    label = f"{title}, mean ± 95 %"
    axis.errorbar(found.centre * factor, mean, error, lw=0.8, capsize=1.5, label=label, **style)
    axis.set_xlabel(f"{found.signal} in {unit}")


@dataclass(frozen=True)
class Rank:
    """A candidate by how clearly the record shows it, in standard deviations.

    after: None once it is part of the model.
    """

    name: str
    before: float | None
    after: float | None


def ranking(ranks: Sequence[Rank], limit: float) -> Figure:
    """Bars of the candidates' clarity before, points after; the limit of significance dashed."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 0.9 + 0.28 * len(ranks)))
        axis = figure.subplots()
        y = np.arange(len(ranks))
        width = [max(WEAKEST, rank.before or 0.0) - WEAKEST for rank in ranks]
        found = [rank.after is None for rank in ranks]
        colours = [ORANGE if own else LINE for own in found]
        axis.barh(y, width, 0.62, left=WEAKEST, color=colours)
        if any(found):
            _points_after(figure, axis, ranks)
        axis.axvline(limit, color=INK, lw=1.1, ls=(0, (5, 3)))
        axis.annotate(f"{limit:g} sd: significant", (limit, -0.85), (4, 0), va="center",
                      textcoords="offset points", fontsize=8)  # fmt: skip
        axis.set_xscale("log")
        axis.set_xlim(WEAKEST, 1.5 * max(2 * limit, *(r.before or 0.0 for r in ranks)))
        axis.xaxis.set_major_formatter(mpl.ticker.FormatStrFormatter("%g"))
        axis.set_yticks(y, [rank.name for rank in ranks])
        axis.set_ylim(len(ranks) - 0.4, -1.2)
        axis.tick_params(axis="y", length=0)
        axis.set_xlabel("coefficient in units of its standard deviation, each effect alone")
    return figure


def _points_after(figure: Figure, axis: Axes, ranks: Sequence[Rank]) -> None:
    left = [(max(WEAKEST, r.after), y) for y, r in enumerate(ranks) if r.after is not None]
    style: dict[str, Any] = {"ls": "", "marker": AFTER[1], "ms": 4.5, "color": AFTER[0]}
    x, y = np.array(left).reshape(-1, 2).T
    points = axis.plot(x, y, clip_on=False, label="after", **style)
    own = Patch(color=ORANGE, label="before: now part of the model")
    before = Patch(color=LINE, label="before")
    figure.legend(handles=[own, before, *points], loc="outside lower center", ncols=3)
