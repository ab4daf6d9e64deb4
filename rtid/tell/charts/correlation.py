"""Is what is left noise: correlations of the innovations with their 95 % bands, and the CUSUM."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rtid.compare import Correlation, Cusum
from rtid.tell.colours import BLUE, GREY, HELD_OUT, INK, ORANGE, PALE, SEEN
from rtid.tell.story import Chart, Dots, Line, Panel, Remark, Shade

MOST_ROOM = 1.35  # times the largest value


def correlogram(correlations: Sequence[Correlation]) -> Chart:
    """One row of panels per chamber: with itself, then with each input."""
    chambers = dict.fromkeys(c.chamber for c in correlations)
    rows = tuple(tuple(_lags(c) for c in correlations if c.chamber == name) for name in chambers)
    caption = "Noise stays within the band at 95 % of the lags."
    heading = "Correlation of what is left"
    return Chart("correlation", heading, rows, caption, "none", size_in=(3.6, 2.5))


def _lags(c: Correlation) -> Panel:
    ms, is_out = c.lags_s * 1e3, np.abs(c.value) > c.band
    lines = (
        Line("correlation", ms, c.value, BLUE, 0.8),
        Line("95 % band of no relation", ms, c.band, GREY, 0.9, is_dashed=True),
        Line("", ms, -c.band, GREY, 0.9, is_dashed=True),
    )
    out = Dots("outside the band", ms[is_out], c.value[is_out], None, ORANGE, is_joined=False)
    feedback = () if c.itself else (Shade("feedback: the signal comes later", ms[0], 0.0, PALE),)
    what = "itself" if c.itself else c.signal
    most = MOST_ROOM * max(np.abs(c.value).max(), c.band.max())
    title = f"chamber {c.chamber} with {what}: {100 * c.outside:.0f} % outside"
    return Panel(title, "lag in ms", "correlation", lines, (out,), feedback, limit=float(most))


def cusum(parts: Mapping[str, Sequence[Cusum]]) -> Chart:
    """Cumulative sums with their boundaries, one row per chamber; each part starts from zero."""
    chambers = dict.fromkeys(c.chamber for cusums in parts.values() for c in cusums)
    rows = tuple((_sums(name, parts),) for name in chambers)
    caption = "A sum that leaves its boundary says that the model begins to fail."
    heading = "Sum of recursive residuals"
    return Chart("cusum", heading, rows, caption, "none", size_in=(10.0, 2.5), is_timed=True)


def _sums(chamber: str, parts: Mapping[str, Sequence[Cusum]]) -> Panel:
    lines: list[Line] = []
    shades, remarks = [], []
    for k, (title, result) in enumerate(parts.items()):
        for c in (c for c in result if c.chamber == chamber and len(c.t_s)):
            lines += _sum(c)
            shades.append(Shade(title, float(c.t_s[0]), float(c.t_s[-1]), HELD_OUT if k else SEEN))
            if c.crosses_s is not None and c.change_s is not None:
                words = f"begins to fail at {c.change_s:.1f} s"
                remarks.append(Remark(c.change_s, words, ORANGE, is_mark=True))
                remarks.append(Remark(c.crosses_s, "leaves", ORANGE, is_mark=True))
    title = f"chamber {chamber}"
    return Panel(title, "time in s", "sum of recursive\nresiduals", tuple(lines), (),
                 tuple(shades), tuple(remarks))  # fmt: skip


def _sum(c: Cusum) -> list[Line]:
    ends = [0, -1]
    edges = [
        Line("5 % boundary", c.t_s[ends], sign * c.boundary[ends], INK, 1.0, is_dashed=True)
        for sign in (1.0, -1.0)
    ]
    return [*edges, Line("cumulative sum", c.t_s, c.value, BLUE, 1.0)]
