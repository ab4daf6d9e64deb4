"""Flows of a chamber's valves as no missing effect bends them: Q = K(w) |dp|^alpha sgn dp.

What is missing and rings bends the free maps, block by block and wildly: by half the flow where a
line of 4 m was missing, and their slopes by 27 times.  Its own column then fits nothing.  The
median of a map's gain over the openings, and the one exponent of a valve, are hardly bent (3 and
7 %).  Not even beside the line do the maps' own flows serve: what a column has of their errors
comes back in the next maps, larger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.effects.record_view import RecordView
from rtid.plain import BoolArray, FloatArray, IntArray

BINS, LEAST = 40, 20  # of the opening; intervals that a bin must have
LEAST_PA = 5e4  # of a drop, below which it is mostly noise
ORIFICE, ROUNDS = 0.5, 3  # the exponent to begin with, and how often it is put right
WIDE = 0.2  # of the largest gain, from which on a gain tells the exponent


@dataclass(frozen=True)
class Gauge:
    """A valve's gain K (m,), m3/s per Pa^alpha, at the openings w (m,), V."""

    w: FloatArray
    gain: FloatArray
    alpha: float

    def at(self, w: FloatArray) -> FloatArray:
        """Gain at openings w (n,), V; shut at 0 and below."""
        return np.where(w > 0.0, np.interp(w, self.w, self.gain), 0.0)


def gauged(view: RecordView, c: int) -> tuple[FloatArray, FloatArray]:
    """Q_0 into chamber c (n - 1,), m3/s, and -dQ_0/dP (n - 1,), m3/s/Pa, not negative."""
    known = view.placed.get(("gauged", c))
    if known is None:
        known = view.placed["gauged", c] = _into(view, c)
    flow, slope = known
    return flow, slope


def _into(view: RecordView, c: int) -> tuple[FloatArray, FloatArray]:
    flow, slope = np.zeros(view.n - 1), np.zeros(view.n - 1)
    for i, edge in enumerate(view.model.edges):
        if sign := edge.sign(view.model.chambers[c]):
            gauge, (drop, size) = _gauge(view.taught or view, i), _drop(view, i)
            through = gauge.at(view.opening(i)) * size**gauge.alpha
            through *= np.minimum(1.0, np.abs(drop) / size)
            flow += sign * np.sign(drop) * through
            slope += gauge.alpha * through / size
    return flow, slope


def _drop(view: RecordView, i: int) -> tuple[FloatArray, FloatArray]:
    """dp of edge i, and its size, which is not below what is mostly noise; (n - 1,), Pa."""
    edge = view.model.edges[i]
    drop = view.signal(edge.source) - view.signal(edge.sink)
    drop = 0.5 * (drop[1:] + drop[:-1])
    return drop, np.maximum(np.abs(drop), LEAST_PA)


def _gauge(view: RecordView, i: int) -> Gauge:
    """The gauge of edge i by a record beside its map."""
    known: Gauge | None = view.placed.get(("gauge", i))
    if known is None:
        known = view.placed["gauge", i] = _measured(view, i)
    return known


def _measured(view: RecordView, i: int) -> Gauge:
    w, (drop, size), alpha = view.opening(i), _drop(view, i), ORIFICE
    open_ = view.inside & (w > 0.0) & (np.abs(drop) > LEAST_PA)
    w, size, forward = w[open_], size[open_], (view.flow(i) * np.sign(drop))[open_]
    bins = _Bins.of(w)
    for _ in range(ROUNDS):
        gauge = bins.medians(forward / size**alpha, alpha)
        alpha = _exponent(forward, gauge.at(w), size, alpha)
    return bins.medians(forward / size**alpha, alpha)


@dataclass(frozen=True)
class _Bins:
    """Bins of the opening that hold enough: order (n,) of the values by bin, middle (m,), V.

    first, last (m,): a bin's places in that order.
    """

    order: IntArray
    middle: FloatArray
    first: IntArray
    last: IntArray

    @classmethod
    def of(cls, w: FloatArray) -> _Bins:
        """Bins of openings w (n,), V."""
        border = np.linspace(0.0, float(w.max(initial=1.0)), BINS + 1)
        place = np.clip(np.searchsorted(border, w, side="right") - 1, 0, BINS - 1)
        last = np.cumsum(np.bincount(place, minlength=BINS))
        first = np.append(0, last[:-1])
        full = np.flatnonzero(last - first >= LEAST)
        middle = 0.5 * (border[full] + border[full + 1])
        order = np.argsort(place.astype(np.int16), kind="stable")
        return cls(order, middle, first[full], last[full])

    def medians(self, gains: FloatArray, alpha: float) -> Gauge:
        """Medians of the gains (n,) over the openings."""
        if not len(self.middle):
            return Gauge(np.zeros(1), np.zeros(1), alpha)
        gains = gains[self.order]
        parts = zip(self.first.tolist(), self.last.tolist(), strict=True)
        usual = [max(0.0, _median(gains[first:last])) for first, last in parts]
        return Gauge(self.middle, np.array(usual), alpha)


def _exponent(forward: FloatArray, gain: FloatArray, size: FloatArray, alpha: float) -> float:
    """The exponent with which small and large drops, thirds of them, give the same gain."""
    wide: BoolArray = gain > WIDE * gain.max(initial=0.0)
    if np.count_nonzero(wide) < BINS:
        return alpha
    low, high = np.quantile(size[wide], (1 / 3, 2 / 3))
    few, much = wide & (size <= low), wide & (size >= high)
    off = [_median(forward[at] / (gain[at] * size[at] ** alpha)) for at in (few, much)]
    apart = float(np.log(_median(size[much]) / _median(size[few])))
    if min(off) <= 0.0 or apart <= 0.0:
        return alpha
    return float(np.clip(alpha + np.log(off[1] / off[0]) / apart, 0.0, 1.0))


def _median(values: FloatArray) -> float:
    """Of two or more finite values (n,); numpy's own takes four times as long for some hundreds."""
    middle = len(values) // 2
    low, high = np.partition(values, (middle - 1, middle))[middle - 1 :][:2].tolist()
    return 0.5 * (low + high) if len(values) % 2 == 0 else float(high)
