"""A record with fewer samples that says the same of slow things, to look for timings from afar.

Signals become means over m samples.  Between the middles of two such windows the mean position
moves by what the flow does over both of them, weighted by a triangle: so do commands and volumes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.kernels.engine import GAP_FLAG, ROW_FLAG
from rtid.model import Machine
from rtid.plain import FloatArray

STEP_S = 5e-3  # of the thinned record
STEADY = 1.5  # usual steps: a longer one is a gap


@dataclass(frozen=True)
class Thinning:
    """m samples of step_s become one; m = 1 where not every sample holds every signal."""

    m: int
    step_s: float

    @classmethod
    def of(cls, model: Machine, chunk: FloatArray) -> Thinning:
        """What a record allows, chunk (n, 2 + signals), SI."""
        step_s = float(np.median(np.diff(chunk[:, 0])))
        every = np.mean(chunk[:, 1].astype(int) & ROW_FLAG) > 0.9
        same = model.pressure_period_s <= STEADY * step_s
        most = min(STEP_S, 0.5 * model.gates.max_gap_s) / step_s
        return cls(max(1, int(most + 1e-9)) if every and same else 1, step_s)

    def model(self, model: Machine) -> Machine:
        """The machine, its pressures still as noisy per second as they were."""
        return replace(model, pressure_period_s=model.pressure_period_s or self.step_s)

    def record(self, model: Machine, chunk: FloatArray) -> FloatArray:
        """The record (n // m, 2 + signals), SI; commands as over the intervals that begin there.

        chunk (n, 2 + signals), SI.
        """
        if self.m == 1:
            return chunk
        windows = self._windows(chunk)
        thin = windows.mean(axis=1)
        flags = windows[:, :, 1].astype(int)
        broken = (flags & GAP_FLAG).any(axis=1)
        broken |= np.ptp(windows[:, :, 0], axis=1) > (self.m - 1) * STEADY * self.step_s
        if model.mode:
            mode = windows[:, :, 2 + model.column(model.mode)]
            broken |= np.ptp(mode, axis=1) > 0
            thin[:, 2 + model.column(model.mode)] = mode[:, 0]
        broken[1:] |= broken[:-1].copy()  # a mean across a gap is nowhere to begin
        thin[:, 1] = ROW_FLAG | np.where(broken, GAP_FLAG, 0)
        for name in {edge.command for edge in model.edges}:
            column = 2 + model.column(name)
            thin[:, column] = self.command(chunk[:, column])
        return thin

    def command(self, command: FloatArray) -> FloatArray:
        """A command (n,) as over the intervals (n // m,) of the thinned record."""
        if self.m == 1:
            return command
        mean = self.over_intervals(command) / self.m
        return np.append(mean, mean[-1:])

    def over_intervals(self, series: FloatArray) -> FloatArray:
        """Sums (n // m - 1,) of a series (n - 1,) per interval, triangle-weighted, in its unit."""
        if self.m == 1:
            return series
        windows, rising = self._windows(series), np.arange(1, self.m + 1) / self.m
        return np.asarray(windows[:-1] @ rising + windows[1:] @ (1.0 - rising))

    def _windows(self, values: FloatArray) -> FloatArray:
        n = len(values) // self.m
        return values[: n * self.m].reshape(n, self.m, *values.shape[1:])
