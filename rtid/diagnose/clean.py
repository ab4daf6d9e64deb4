"""What of a record can be used: a sensor at the end of its range says nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtid.diagnose.view import has_noise
from rtid.kernels.engine import GAP_FLAG
from rtid.model import PRESSURE, FloatArray, Model


def saturated(model: Model, chunk: FloatArray) -> NDArray[np.bool_]:
    """Samples (n,) at which a pressure stands at the end of its declared range."""
    found = np.zeros(len(chunk), bool)
    for j, signal in enumerate(model.signals):
        if signal.kind == PRESSURE and np.ptp(chunk[:, 2 + j]) > 0:
            value, reach = chunk[:, 2 + j], 1.5 * signal.resolution
            found |= (value <= signal.minimum + reach) | (value >= signal.maximum - reach)
    return found


def as_measured(model: Model, chunk: FloatArray) -> Model:
    """The model with no noise on pressures that are no measurements but computed values."""
    signals = tuple(
        replace(s, noise=0.0, resolution=0.0)
        if s.kind == PRESSURE and not has_noise(chunk[:, 2 + j])
        else s
        for j, s in enumerate(model.signals)
    )
    return replace(model, signals=signals)


def usable(model: Model, chunk: FloatArray) -> FloatArray:
    """The record with a gap at every saturated sample and at the one behind it."""
    bad = saturated(model, chunk)
    if not bad.any():
        return chunk
    bad[1:] |= bad[:-1].copy()
    chunk = chunk.copy()
    chunk[bad, 1] = chunk[bad, 1].astype(int) | GAP_FLAG
    return chunk
