"""filterpy's extended and unscented Kalman filters, with a valve of a short parametric law.

State per chamber: P, 1 / beta, and four numbers of each of its two valves (`chamber`), which walk
at random by little; the pressure is measured.  Two passes over the record, the second from where
the first has ended.  filterpy (MIT).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from benchmarks.missing.chamber import SHORT, ChamberData, chambers, flow_of, start_short, step
from benchmarks.missing.chamber import edge_flow as law
from benchmarks.missing.front import Front
from benchmarks.missing.methods.data_sheet import predicted
from benchmarks.missing.record import Learned, Record
from rtid.plain import FloatArray

PRIOR_SD = np.array([0.25, 0.25, 0.25, 0.03, 1.5])  # 1/beta (1/GPa, relative), and of a valve
WALK = np.array([2e-7, 2e-6, 4e-6, 4e-7, 2e-5])  # per sample
NOISE_MPA, MODEL_MPA = 5e-3, 2e-2  # of the sensor; of one step of the equation
PASSES = 2
NO_KNOTS = np.zeros((2, 0))
Run = Callable[[ChamberData, FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


def moved(x: FloatArray, data: ChamberData, k: int, dt_s: float) -> FloatArray:
    """The state (n,) one step later."""
    after = x.copy()
    row, then = data.rows[k], data.rows[min(k + 1, len(data.rows) - 1)]
    after[0] = 1e-6 * step(1e6 * x[0], x[1:], NO_KNOTS, data.sign, row, then, dt_s)
    return after


def extended(
    data: ChamberData, x: FloatArray, P: FloatArray, Q: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """One pass of the extended filter; the Jacobian by differences."""
    n = len(x)
    ekf = ExtendedKalmanFilter(n, 1)
    ekf.x, ekf.P, ekf.Q, ekf.R = x[:, None].copy(), P.copy(), Q, np.array([[NOISE_MPA**2]])
    h, small = np.eye(1, n), 1e-5 * np.maximum(np.abs(x), 0.1)
    ahead = x
    ekf.predict_x = lambda u=0: setattr(ekf, "x", ahead[:, None])
    for k in range(len(data.p_pa) - 1):
        now = ekf.x[:, 0]
        ahead, F = moved(now, data, k, data.dt_s), np.eye(n)
        for j in range(n):
            other = now.copy()
            other[j] += small[j]
            F[0, j] = (moved(other, data, k, data.dt_s)[0] - ahead[0]) / small[j]
        ekf.F = F
        ekf.predict()
        ekf.update(np.array([[1e-6 * data.p_pa[k + 1]]]), lambda _: h, lambda at: at[:1])
    return ekf.x[:, 0], ekf.P


def unscented(
    data: ChamberData, x: FloatArray, P: FloatArray, Q: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """One pass of the unscented filter over every second sample."""
    n, at = len(x), [0]
    points = MerweScaledSigmaPoints(n, alpha=0.3, beta=2.0, kappa=3.0 - n)

    def fx(state: FloatArray, dt: float) -> FloatArray:
        half = moved(state, data, at[0], data.dt_s)
        return moved(half, data, at[0] + 1, data.dt_s)

    ukf = UnscentedKalmanFilter(n, 1, 2 * data.dt_s, lambda state: state[:1], fx, points)
    ukf.x, ukf.P, ukf.Q, ukf.R = x.copy(), P.copy(), 2 * Q, np.array([[NOISE_MPA**2]])
    for k in range(0, len(data.p_pa) - 2, 2):
        at[0] = k
        ukf.predict()
        ukf.update(np.array([1e-6 * data.p_pa[k + 2]]))
        ukf.P = 0.5 * (ukf.P + ukf.P.T)
    return ukf.x, ukf.P


class Kalman:
    """One of the two."""

    def __init__(self, name: str, run: Run, passes: int) -> None:
        self._name, self._run, self._passes = name, run, passes

    def name(self) -> str:
        """Its row."""
        return self._name

    def learn(self, train: Record) -> Learned:
        """A filter per chamber, and what it believes at the end."""
        front = Front(train)
        beta, beta_sd, thetas, covs = [], [], {}, {}
        for data in chambers(front):
            x, P = self._chamber(front, data)
            beta.append(1e9 / x[1])
            beta_sd.append(beta[-1] / x[1] * np.sqrt(P[1, 1]))
            for k, e in enumerate(data.edges):
                i = slice(2 + k * SHORT, 2 + (k + 1) * SHORT)
                thetas[e], covs[e] = x[i].copy(), P[i, i].copy()
        names = tuple(e.name for e in train.machine.edges)
        flow = flow_of(names, thetas, dict.fromkeys(thetas, np.zeros(0)))

        def sd(edge: str, w_v: object, dp_pa: object) -> FloatArray:
            e = names.index(edge)
            return _sd(thetas[e], covs[e], np.asarray(w_v, float), np.asarray(dp_pa, float))

        beta_pa = np.array(beta)
        return Learned(
            lambda test: predicted(test, flow, beta_pa), flow, sd, beta_pa, np.array(beta_sd)
        )

    def _chamber(self, front: Front, data: ChamberData) -> tuple[FloatArray, FloatArray]:
        nominal = 1e9 / front.samples.machine.beta_nominal_pa
        valves = [start_short(front.samples, e) for e in data.edges]
        x = np.concatenate([[1e-6 * data.p_pa[0], nominal], *valves])
        sd = np.concatenate([[NOISE_MPA, PRIOR_SD[0] * nominal], PRIOR_SD[1:], PRIOR_SD[1:]])
        walk = np.concatenate([[MODEL_MPA], WALK[:1], WALK[1:], WALK[1:]])
        for _ in range(self._passes):
            x, P = self._run(data, x, np.diag(sd**2), np.diag(walk**2))
            x[0] = 1e-6 * data.p_pa[0]
            sd = np.maximum(0.2 * sd, 0.0)
        return x, P


def _sd(theta: FloatArray, cov: FloatArray, w: FloatArray, dp: FloatArray) -> FloatArray:
    """Standard deviation of the flow at points (n,), m3/s, to first order."""
    none, columns = np.zeros(0), np.empty((len(w), SHORT))
    for j in range(SHORT):
        other = theta.copy()
        other[j] += 1e-4
        pairs = zip(w, dp, strict=True)
        columns[:, j] = [(law(none, other, a, b) - law(none, theta, a, b)) / 1e-4 for a, b in pairs]
    return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", columns, cov, columns), 0.0))


METHODS = (Kalman("EKF (filterpy)", extended, PASSES), Kalman("UKF (filterpy)", unscented, 1))
