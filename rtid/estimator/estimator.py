"""The estimator: samples in, state on, solution out.  Knows no bus, no file and no clock."""

from __future__ import annotations

import numpy as np

from firmware_bridge.samples import Samples
from rtid.estimator.solution import Solution, solve
from rtid.estimator.state import State, Weights, build
from rtid.kernels.layout import COUNTERS
from rtid.model import FloatArray, Model


def to_chunk(model: Model, samples: Samples, origin_us: int) -> FloatArray:
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


class Estimator:
    """Learns all maps and compliances of a model together, sample by sample or trace by trace.

    The result does not depend on how the samples are cut into calls, bit for bit.
    """

    def __init__(self, model: Model, weights: Weights | None = None) -> None:
        self.model = model
        self.weights = weights
        self.reset()

    def reset(self) -> None:
        """Forget everything that was learned."""
        self.state: State = build(self.model, self.weights)
        self.origin_us: int | None = None

    def update(self, samples: Samples) -> None:
        """Take a run of samples in their order."""
        if len(samples) == 0:
            return
        if self.origin_us is None:
            self.origin_us = int(samples.t_us[0])
        self.state.advance(to_chunk(self.model, samples, self.origin_us))

    @property
    def counters(self) -> dict[str, int]:
        """Samples, rows, and how often a sample was refused or a memory restarted, by reason."""
        counts = self.state.engine[0]["counters"].tolist()
        return dict(zip(COUNTERS, counts, strict=True))

    def solution(self) -> Solution:
        """The joint estimate from everything seen so far; nothing is changed by asking."""
        return solve(self.model, self.state)

    def copy(self) -> Estimator:
        """An independent estimator that continues bit for bit like this one."""
        twin = Estimator.__new__(Estimator)
        twin.model, twin.weights = self.model, self.weights
        twin.state, twin.origin_us = self.state.copy(), self.origin_us
        return twin
