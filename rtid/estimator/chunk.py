"""Samples as the kernels take them: rows of numbers, without the estimator's weight."""

from __future__ import annotations

import numpy as np

from firmware_bridge.samples import Samples
from rtid.errors import door
from rtid.model import Machine
from rtid.plain import FloatArray


@door
def to_chunk(model: Machine, samples: Samples, origin_us: int) -> FloatArray:
    """The kernel's view of samples: (n, 2 + signals) = [s since origin_us, flags, values...].

    Raises KeyError if a signal of the model is missing among the samples.
    """
    missing = [s.name for s in model.signals if s.name not in samples.names]
    if missing:
        raise KeyError(f"the samples lack {', '.join(missing)}")
    chunk = np.empty((len(samples), 2 + len(model.signals)))
    chunk[:, 0] = (samples.t_us - origin_us) * 1e-6
    chunk[:, 1] = samples.flags
    chunk[:, 2:] = samples.values[:, [samples.names.index(s.name) for s in model.signals]]
    return chunk
