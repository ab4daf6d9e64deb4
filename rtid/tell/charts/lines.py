"""Lines of a record, of which the browser draws what is seen (`static/plots.js`).

The least and the largest value of every bin are always drawn, at any zoom.  A report has its lines
whole; a page is sent the whole record in bins, and what it zooms to more finely as soon as it asks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure

from rtid.plain import FloatArray
from rtid.tell.charts.theme import INK_TAG, lean
from rtid.tell.colours import INK

BINS = 2000  # of what a page is sent: twice the pixels of a wide plot
THINNED = "thinned"
ROWS = 3  # of a bin: its least and largest value, and its last one
Column = Callable[[slice], FloatArray]  # the values of some rows, in the unit of the plot
Part = tuple[FloatArray, Mapping[str, Column]]  # times (n,), s, and what is drawn over them
Piece = tuple[FloatArray, Mapping[str, FloatArray]]  # the same without a gap


class Lines:
    """Lines that share their times; is_whole: all of them is sent at once, for want of a server."""

    def __init__(self, is_whole: bool = False) -> None:
        self._bins = 0 if is_whole else BINS
        self.whole, self.detail = (ColumnDataSource({"t": []}) for _ in range(2))
        self._parts: list[Part] = []
        self._window: tuple[float, float] | None = None
        self._drawn: dict[str, list[ColumnDataSource]] = {}

    def add(self, made: figure, name: str, colour: str, width: float) -> None:
        """Draw the column `name` in a plot."""
        drawn = ColumnDataSource({"t": [], "y": []}, tags=[self.whole, name, self.detail])
        self._drawn.setdefault(name, []).append(drawn)
        line = lean(made.line("t", "y", source=drawn, line_width=width))
        line.glyph.line_color = INK if colour == INK_TAG else colour
        if colour == INK_TAG:
            line.glyph.tags = [INK_TAG]

    def show(self, parts: Iterable[Part]) -> None:
        """Every part of the record; none: nothing is drawn."""
        self._parts = list(parts)
        self._send(self.whole, -np.inf, np.inf)
        if self._window is not None:
            self._send(self.detail, *self._window)
        for name, sources in self._drawn.items():
            for drawn in sources:
                if drawn.document is None:  # from then on, it is the page that draws
                    drawn.data = _corners(self.whole.data, name)

    def zoom(self, low: float, high: float) -> None:
        """Have a window of the record, s, more finely: somebody looks at it."""
        self._window = low, high
        self._send(self.detail, low, high)

    def _send(self, source: ColumnDataSource, low: float, high: float) -> None:
        """Its name says whether more can be had of what is sent."""
        cut = [_cut(part, low, high, self._drawn.keys()) for part in self._parts]
        pieces = [piece for t, columns in cut for piece in unbroken(t, columns)]
        n = sum(len(t) for t, _ in pieces)
        is_thin = 0 < ROWS * self._bins < n
        if is_thin:
            pieces = [thinned(*p, max(1, round(self._bins * len(p[0]) / n))) for p in pieces]
        source.name = THINNED if is_thin else None
        source.data = joined(pieces)


def _cut(part: Part, low: float, high: float, names: Iterable[str]) -> Piece:
    """The rows of a part that lie in a window, and one at either side of it."""
    t, columns = part
    first, last = np.searchsorted(t, (low, high)).tolist()
    rows = slice(max(first - 1, 0), last + 1)
    return t[rows], {name: columns[name](rows) for name in names if name in columns}


def unbroken(t: FloatArray, columns: Mapping[str, FloatArray]) -> list[Piece]:
    """Times (n,), s, and columns (n,) in the unit of their plot, between the gaps of the times."""
    at = [0, *_gaps(t).tolist(), len(t)] if len(t) else [0]
    return [(t[a:b], {name: y[a:b] for name, y in columns.items()}) for a, b in pairwise(at)]


def thinned(t: FloatArray, columns: Mapping[str, FloatArray], bins: int) -> Piece:
    """Least, largest and last value of every bin, NaN in place of the last where one is missing.

    t (n,), s, and columns (n,) in the unit of their plot; few of them are left as they are.
    """
    n = len(t)
    if n <= ROWS * bins:
        return t, columns
    ends = np.arange(1, bins + 1) * n // bins
    first = np.concatenate([[0], ends[:-1]])
    rows = np.column_stack([first, (first + ends) // 2, ends - 1]).ravel()
    return t[rows], {name: _extremes(y, first, ends - 1) for name, y in columns.items()}


def _extremes(y: FloatArray, first: np.ndarray, last: np.ndarray) -> FloatArray:
    """(bins * ROWS,) of a column; the extremes in the order that its ends suggest."""
    least, most = np.fmin.reduceat(y, first), np.fmax.reduceat(y, first)
    is_rising = y[first] <= y[last]
    end = np.where(np.logical_or.reduceat(np.isnan(y), first), np.nan, y[last])
    pair = np.where(is_rising, least, most), np.where(is_rising, most, least)
    return np.column_stack([*pair, end]).ravel().astype(y.dtype)


def _corners(whole: Mapping[str, Any], name: str) -> dict[str, list[float]]:
    """Two ends of a line that are not joined: a new plot has the right axes at once."""
    t, y = whole["t"], whole.get(name, np.empty(0))
    if not np.isfinite(y).any():
        return {"t": [], "y": []}
    low, high = float(np.nanmin(y)), float(np.nanmax(y))
    return {"t": [t[0], t[0], t[-1]], "y": [low, np.nan, high]}


def joined(pieces: Iterable[Piece]) -> dict[str, FloatArray]:
    """Pieces one after the other, the lines broken between them.

    Times (n,), s, and columns (n,) in the unit of their plot, NaN where a line is broken.
    """
    every: dict[str, list[FloatArray]] = {"t": [np.empty(0)]}
    for t, columns in pieces:
        every["t"] += [t, t[-1:]]
        for name, y in columns.items():
            every[name] = [*every.get(name, []), y, np.array([np.nan])]
    return {
        name: np.concatenate(values).astype(np.float64 if name == "t" else np.float32)
        for name, values in every.items()
    }


def _gaps(t: FloatArray) -> np.ndarray:
    """Where a step is more than five usual ones."""
    if len(t) < 3:
        return np.empty(0, int)
    step = np.diff(t)
    return np.flatnonzero(step > 5 * np.median(step)) + 1
