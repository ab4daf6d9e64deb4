"""The least-squares problem of a free run, in unknowns of size one.

Errors come for many sets of values at once, and so does the Jacobian: by differences in one run of
all lanes, which costs little more than that of one.  On the way to the least squares they are
one-sided, and come with the error itself; what is told of a fit is by central ones.
"""

from __future__ import annotations

import numpy as np

from rtid.plain import BoolArray, FloatArray
from rtid.plants.plant import PlantError, PlantParameter
from rtid.plants.simulator import Simulator

FINE, ROUGH = 1e-6, 1e-3  # relative change of the sum of squares that ends a fit
ROUNDING = 1e-5  # step of the differences, of a parameter's scale
FAR = 1e3  # residual of a run that has left every range, in units of the output


def bounds(unknowns: tuple[PlantParameter, ...]) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest values (unknowns,), in their units."""
    return np.array([p.low for p in unknowns]), np.array([p.high for p in unknowns])


def steps(unknowns: tuple[PlantParameter, ...]) -> FloatArray:
    """The scale (unknowns,) of every unknown, in its unit."""
    steps_of = []
    for p in unknowns:
        width = p.high - p.low
        size = max(abs(p.start), 0.01 * width if np.isfinite(width) else 0.0)
        steps_of.append(size or 1.0)
    return np.array(steps_of)


def scales(simulator: Simulator) -> FloatArray:
    """What the errors (outputs,) are divided by, in their units: the noise, else the spread."""
    noise = np.array([o.noise for o in simulator.plant.outputs])
    spread = np.nanstd(simulator.record.y, axis=0)
    if not (spread > 0).all():
        raise PlantError("an output does not move", "a fit needs a record with motion")
    return spread if np.isnan(noise).any() else noise


class FitProblem:
    """The least-squares problem in scaled unknowns; `open` are those that may move."""

    def __init__(
        self, simulator: Simulator, values: FloatArray, opened: BoolArray, mask: BoolArray
    ) -> None:
        self.simulator, self.values, self.open = simulator, values, opened
        self.mask = mask
        unknowns = simulator.plant.unknowns
        self.step, (self.low, self.high) = steps(unknowns), bounds(unknowns)
        self.scale = scales(simulator)
        self._last: tuple[FloatArray, FloatArray, FloatArray] | None = None

    def errors(self, lanes: FloatArray) -> FloatArray:
        """Errors (samples used, lanes), scaled, for values (unknowns, lanes)."""
        y, _ = self.simulator.run(np.ascontiguousarray(lanes))
        wrong = (y - self.simulator.record.y[:, :, None]) / self.scale[:, None]
        return np.nan_to_num(wrong[self.mask], nan=FAR, posinf=FAR, neginf=-FAR)

    def full(self, z: FloatArray) -> FloatArray:
        """All values (unknowns,) for scaled ones of those that may move."""
        values = self.values.copy()
        values[self.open] = z * self.step[self.open]
        return np.clip(values, self.low, self.high)

    def error(self, z: FloatArray) -> FloatArray:
        """Errors (samples used,), scaled, of one set."""
        return self._at(z)[0]

    def one_sided(self, z: FloatArray) -> FloatArray:
        """Jacobian (samples used, open unknowns), scaled, by the run that gave the error at z."""
        return self._at(z)[1]

    def _at(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Error and one-sided Jacobian at z, which are asked for one after the other."""
        if self._last is not None and np.array_equal(self._last[0], z):
            return self._last[1:]
        values, index = self.full(z), np.flatnonzero(self.open)
        h = ROUNDING * self.step[index]
        h = np.where(values[index] + h > self.high[index], -h, h)
        lanes = np.repeat(values[:, None], 1 + len(index), axis=1)
        lanes[index, 1 + np.arange(len(index))] += h
        e = self.errors(lanes)
        self._last = z.copy(), e[:, 0], (e[:, 1:] - e[:, :1]) / (h / self.step[index])
        return self._last[1:]

    def slopes(self, z: FloatArray) -> FloatArray:
        """Jacobian (samples used, open unknowns), scaled, by central differences, in one run."""
        values, index = self.full(z), np.flatnonzero(self.open)
        lanes = np.repeat(values[:, None], 2 * len(index), axis=1)
        h = ROUNDING * self.step[index]
        for k, i in enumerate(index):
            lanes[i, 2 * k] = min(values[i] + h[k], self.high[i])
            lanes[i, 2 * k + 1] = max(values[i] - h[k], self.low[i])
        apart = (lanes[index, 0::2] - lanes[index, 1::2]).diagonal() / self.step[index]
        e = self.errors(lanes)
        return (e[:, 0::2] - e[:, 1::2]) / apart

    def solve(
        self, start: FloatArray, most: int, tolerance: float = FINE
    ) -> tuple[FloatArray, float]:
        """Best scaled values (open unknowns,) from a start, and half their sum of squares."""
        from scipy.optimize import least_squares  # noqa: PLC0415 - takes long to import

        low = self.low[self.open] / self.step[self.open]
        high = self.high[self.open] / self.step[self.open]
        at = start[self.open] / self.step[self.open]
        inset = 1e-9 * np.maximum(1.0, np.abs(at))  # scipy wants a start inside
        at = np.clip(at, low + inset, high - inset)
        done = least_squares(
            self.error, at, self.one_sided, (low, high), x_scale="jac", max_nfev=most,
            ftol=tolerance, xtol=1e-8,
        )  # fmt: skip
        return self.full(done.x), float(done.cost)
