"""The signals of effects that are evaluated beside the kernels, made of samples in their order."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rtid.plain import FloatArray

if TYPE_CHECKING:
    from rtid.effects.live import LiveFlow
    from rtid.effects.summed import RunningSum


class FlowSums:
    """The signals of live flows, made of samples in their order."""

    def __init__(self, flows: tuple[LiveFlow | RunningSum, ...]) -> None:
        self.flows = flows
        self._last: FloatArray | None = None
        self._sums = np.zeros(len(flows))

    def with_flows(self, chunk: FloatArray) -> FloatArray:
        """Samples as they came (n, 2 + signals), with a column in m3 for each flow behind them."""
        if not self.flows:
            return chunk
        if not len(chunk):
            return np.empty((0, chunk.shape[1] + len(self.flows)))
        begun = chunk[:1] if self._last is None else self._last
        rows = np.concatenate([begun, chunk])
        flowed = np.column_stack([flow.volumes(rows) for flow in self.flows])
        # one by one, in whatever pieces they come
        sums = np.cumsum(np.vstack([self._sums, flowed]), axis=0)[1:]
        self._last, self._sums = chunk[-1:].copy(), sums[-1]
        return np.hstack([chunk, sums])
