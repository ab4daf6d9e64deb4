"""What of a record can be used: a sensor at the end of its range says nothing.

What is cut is said: a chamber that cavitates holds its pressure at the lowest of the range.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rtid.effects.record_view import has_noise
from rtid.kernels.engine import GAP_FLAG
from rtid.model import PRESSURE, Machine, Signal
from rtid.plain import BoolArray, FloatArray

MOST_SPANS = 20  # that are told of each end


@dataclass(frozen=True)
class Cut:
    """What one end of a pressure's range has cut: share of the samples, its longest spans in s.

    is_low: at the lowest of the range, `limit_pa`.
    """

    signal: str
    is_low: bool
    limit_pa: float
    share: float
    spans_s: tuple[tuple[float, float], ...]


def saturated(model: Machine, chunk: FloatArray) -> BoolArray:
    """Samples (n,) with a pressure at the end of its declared range; chunk (n, 2 + signals), SI."""
    stuck = np.zeros(len(chunk), bool)
    for _, _, at_end in _ends(model, chunk):
        stuck |= at_end
    return stuck


def cuts(model: Machine, chunk: FloatArray) -> tuple[Cut, ...]:
    """What the ends of the pressures' ranges have cut of a record, chunk (n, 2 + signals), SI."""
    t_s = chunk[:, 0] - chunk[0, 0] if len(chunk) else chunk[:, 0]
    return tuple(
        Cut(
            signal.name,
            is_low,
            signal.minimum if is_low else signal.maximum,
            float(np.mean(at_end)),
            _longest(t_s, at_end),
        )
        for signal, is_low, at_end in _ends(model, chunk)
        if at_end.any()
    )


def _ends(model: Machine, chunk: FloatArray) -> Iterator[tuple[Signal, bool, BoolArray]]:
    """Every pressure that moves, and the samples at the lower and at the upper end of its range."""
    for j, signal in enumerate(model.signals):
        if signal.kind == PRESSURE and np.ptp(chunk[:, 2 + j]) > 0:
            value, reach = chunk[:, 2 + j], 1.5 * signal.resolution
            yield signal, True, value <= signal.minimum + reach
            yield signal, False, value >= signal.maximum - reach


def _longest(t_s: FloatArray, at_end: BoolArray) -> tuple[tuple[float, float], ...]:
    """The longest spans in which samples (n,) are at an end, in the order of time."""
    change = np.diff(np.concatenate([[False], at_end, [False]]).astype(int))
    first, last = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
    spans = sorted(zip(t_s[first], t_s[last], strict=True), key=lambda s: s[0] - s[1])
    return tuple(sorted((float(a), float(b)) for a, b in spans[:MOST_SPANS]))


def as_measured(model: Machine, chunk: FloatArray) -> Machine:
    """The model with no noise on pressures beside the chambers' that are computed, not measured.

    A chamber's pressure that is as smooth was filtered.  chunk (n, 2 + signals), SI.
    """
    chambers = {chamber.pressure for chamber in model.chambers}
    signals = tuple(
        replace(s, noise=0.0, resolution=0.0)
        if s.kind == PRESSURE and s.name not in chambers and not has_noise(chunk[:, 2 + j])
        else s
        for j, s in enumerate(model.signals)
    )
    return replace(model, signals=signals)


def usable(model: Machine, chunk: FloatArray) -> FloatArray:
    """The record (n, 2 + signals), SI, with a gap at every saturated sample and the next."""
    bad = saturated(model, chunk)
    if not bad.any():
        return chunk
    bad[1:] |= bad[:-1].copy()
    chunk = chunk.copy()
    chunk[bad, 1] = chunk[bad, 1].astype(int) | GAP_FLAG
    return chunk
