"""Lines of a record: whole in the page, which draws of them what is seen (`static/plots.js`).

The least and the largest value of every bin are always drawn, at any zoom, without asking the
server.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure

from rtid.plain import FloatArray
from rtid.tell.charts.theme import INK_TAG
from rtid.tell.colours import INK

Columns = Mapping[str, FloatArray]


class Lines:
    """Lines that share their times."""

    def __init__(self) -> None:
        self.whole = ColumnDataSource({"t": []})
        self._drawn: dict[str, list[ColumnDataSource]] = {}

    def add(self, made: figure, name: str, colour: str, width: float) -> None:
        """Draw the column `name` in a plot."""
        drawn = ColumnDataSource({"t": [], "y": []}, tags=[self.whole, name])
        self._drawn.setdefault(name, []).append(drawn)
        line = made.line("t", "y", source=drawn, line_width=width)
        line.glyph.line_color = INK if colour == INK_TAG else colour
        line.nonselection_glyph = None
        if colour == INK_TAG:
            line.glyph.tags = [INK_TAG]

    def show(self, parts: Iterable[tuple[FloatArray, Columns]]) -> None:
        """Times (n,), s, and columns (n,) in the unit of their plot, of every part of the record.

        No part: nothing is drawn.
        """
        wanted = ((t, {k: v for k, v in y.items() if k in self._drawn}) for t, y in parts)
        self.whole.data = joined(wanted)
        for name, sources in self._drawn.items():
            for drawn in sources:
                if drawn.document is None:  # from then on, it is the page that draws
                    drawn.data = _corners(self.whole.data, name)


def _corners(whole: Mapping[str, Any], name: str) -> dict[str, list[float]]:
    """Two ends of a line that are not joined: a new plot has the right axes at once."""
    t, y = whole["t"], whole.get(name, np.empty(0))
    if not np.isfinite(y).any():
        return {"t": [], "y": []}
    low, high = float(np.nanmin(y)), float(np.nanmax(y))
    return {"t": [t[0], t[0], t[-1]], "y": [low, np.nan, high]}


def joined(parts: Iterable[tuple[FloatArray, Columns]]) -> dict[str, FloatArray]:
    """Parts one after the other, the lines broken between them and at gaps of their times.

    Times (n,), s, and columns (n,) in the unit of their plot, NaN where a line is broken.
    """
    pieces: dict[str, list[FloatArray]] = {"t": [np.empty(0)]}
    for t, columns in parts:
        if len(t):
            at = _gaps(t)
            pieces["t"] += [np.insert(t, at, t[at - 1]), t[-1:]]
            for name, y in columns.items():
                broken = [np.insert(y, at, np.nan), np.array([np.nan])]
                pieces[name] = pieces.get(name, []) + broken
    return {
        name: np.concatenate(piece).astype(np.float64 if name == "t" else np.float32)
        for name, piece in pieces.items()
    }


def _gaps(t: FloatArray) -> np.ndarray:
    """Where a step is more than five usual ones."""
    if len(t) < 3:
        return np.empty(0, int)
    step = np.diff(t)
    return np.flatnonzero(step > 5 * np.median(step)) + 1
