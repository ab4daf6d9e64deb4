"""Output error: each chamber's pressure is integrated, and its miss is what is made small.

The gain of a valve is linear between twelve knots, with a laminar foot; free runs of 0.1 s start
from the filtered pressure.  scipy's trust region (`least_squares`, soft-l1 loss), from the map of
the linear least squares; intervals from its Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares

from benchmarks.missing.chamber import (
    FAST_S,
    FLOW,
    USUAL_PA,
    ChamberData,
    chambers,
    flow_of,
    windows,
)
from benchmarks.missing.front import Front
from benchmarks.missing.linear import LinearMap, fitted
from benchmarks.missing.methods.data_sheet import predicted
from benchmarks.missing.methods.least_squares import bases
from benchmarks.missing.record import Learned, Record
from rtid.plain import FloatArray

KNOTS = np.array([1.2, 1.5, 1.7, 1.9, 2.1, 2.4, 2.8, 3.4, 4.2, 5.2, 6.5, 8.0, 10.0])
WINDOW, EVERY = 100, 10  # samples
KNOWN_PA = 5e3  # of a pressure: what is beyond it is pulled in by the loss
BETA_PA = (200e6, 1600e6)


@dataclass(frozen=True)
class Fitted:
    """theta of `chamber.slope` and its covariance."""

    theta: FloatArray
    cov: FloatArray


def started(front: Front, linear: LinearMap, data: ChamberData) -> FloatArray:
    """The least squares map: 1 / beta, then per valve the gains at the knots and a foot."""
    c = int(np.flatnonzero(front.samples.sign[:, data.edges[0]] == data.sign[0])[0])
    theta = [1e9 / linear.beta_pa[c]]
    for e in data.edges:
        name = front.samples.machine.edges[e].name
        visited = data.rows[:, data.edges.index(e)].max() > KNOTS
        gains = linear.flow(name, KNOTS, np.full(len(KNOTS), USUAL_PA)) / FLOW
        gains = np.maximum.accumulate(np.maximum(gains[visited], 0.0))
        rise = (gains[-1] - gains[-2]) / (KNOTS[len(gains) - 1] - KNOTS[len(gains) - 2])
        beyond = gains[-1] + rise * (KNOTS[~visited] - KNOTS[len(gains) - 1])
        theta += [*gains, *beyond, np.log(0.3)]
    return np.array(theta)


def fit(front: Front, linear: LinearMap, data: ChamberData) -> Fitted:
    """The unknowns that make the free runs' miss small."""
    start = np.asarray(gaussian_filter1d(data.p_pa, FAST_S / data.dt_s))
    count = (len(start) - 1) // WINDOW
    simulated = np.empty((count, WINDOW // EVERY))
    knots, m = np.stack([KNOTS, KNOTS]), len(KNOTS) + 1
    at = (np.arange(count)[:, None] * WINDOW) + EVERY * (1 + np.arange(WINDOW // EVERY))
    measured = data.p_pa[at]

    def miss(theta: FloatArray) -> FloatArray:
        windows(start, theta, knots, data.sign, data.rows, WINDOW, EVERY, data.dt_s, simulated)
        return np.asarray((simulated - measured) / KNOWN_PA).ravel()

    first = started(front, linear, data)
    low, high = np.full(len(first), -0.05), np.full(len(first), 60.0)
    low[0], high[0] = 1e9 / BETA_PA[1], 1e9 / BETA_PA[0]
    low[[m, 2 * m]], high[[m, 2 * m]] = np.log(1e-4), np.log(8.0)
    scale = np.maximum(np.abs(first), 0.1)
    found = least_squares(
        miss, np.clip(first, low, high), bounds=(low, high), x_scale=scale, loss="soft_l1",
        max_nfev=30, f_scale=2.0,
    )  # fmt: skip
    left = 2.0 * found.cost / max(1, found.fun.size - len(first))
    jacobian = np.asarray(found.jac)
    cov = left * np.linalg.pinv(jacobian.T @ jacobian + 1e-9 * np.eye(len(first)))
    return Fitted(found.x, cov)


class OutputError:
    """One fit per chamber."""

    def name(self) -> str:
        """Its row."""
        return "output error (scipy)"

    def learn(self, train: Record) -> Learned:
        """Maps and moduli."""
        front, thetas, knots = Front(train), {}, {}
        linear = fitted(front, bases(front.samples))
        beta, sd = [], []
        for data in chambers(front):
            answer, m = fit(front, linear, data), len(KNOTS) + 1
            beta.append(1e9 / answer.theta[0])
            sd.append(beta[-1] / answer.theta[0] * np.sqrt(answer.cov[0, 0]))
            for k, e in enumerate(data.edges):
                thetas[e], knots[e] = answer.theta[1 + k * m : 1 + (k + 1) * m], KNOTS
        flow = flow_of(tuple(e.name for e in train.machine.edges), thetas, knots)
        beta_pa = np.array(beta)
        return Learned(
            lambda test: predicted(test, flow, beta_pa), flow, None, beta_pa, np.array(sd)
        )


METHODS = (OutputError(),)
