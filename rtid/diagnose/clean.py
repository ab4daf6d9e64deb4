"""What of a record can be used: a sensor at the end of its range says nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.effects.record_view import has_noise
from rtid.kernels.engine import GAP_FLAG
from rtid.model import PRESSURE, Machine
from rtid.plain import BoolArray, FloatArray


def saturated(model: Machine, chunk: FloatArray) -> BoolArray:
    """Samples (n,) with a pressure at the end of its declared range; chunk (n, 2 + signals), SI."""
    stuck = np.zeros(len(chunk), bool)
    for j, signal in enumerate(model.signals):
        if signal.kind == PRESSURE and np.ptp(chunk[:, 2 + j]) > 0:
            value, reach = chunk[:, 2 + j], 1.5 * signal.resolution
            stuck |= (value <= signal.minimum + reach) | (value >= signal.maximum - reach)
    return stuck


def as_measured(model: Machine, chunk: FloatArray) -> Machine:
    """The model with no noise on pressures that are no measurements but computed values.

    chunk (n, 2 + signals), SI.
    """
    signals = tuple(
        replace(s, noise=0.0, resolution=0.0)
        if s.kind == PRESSURE and not has_noise(chunk[:, 2 + j])
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
