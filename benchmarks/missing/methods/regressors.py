"""Maps by general regressors on filtered derivatives, as studies of flow mapping compare them.

Per valve, with the modulus of the linear fit (`least_squares`), the flow that the chamber's balance
asks for is a target, and (command behind its lag, signed root of the pressure drop) are the inputs,
in rows that stand apart from steps of the command.  scikit-learn, but for the first two's kernels.

    RBF network     Gaussian centres by k-means, linear weights by cross-validated ridge
    GRNN            Nadaraya-Watson: the rows themselves are centres, width by leave-one-out
    LSSVM           kernel ridge, width and ridge by cross-validation
    GP              Gaussian process, lengths and noise by marginal likelihood
    neural net      two hidden layers of 24, L-BFGS, best of three starts on held-out rows
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import GridSearchCV
from sklearn.neural_network import MLPRegressor

from benchmarks.missing.front import Front
from benchmarks.missing.linear import fitted
from benchmarks.missing.methods.data_sheet import predicted
from benchmarks.missing.methods.least_squares import bases
from benchmarks.missing.record import Learned, Record
from rtid.plain import FloatArray

MOST_ROWS = 450  # of a kernel's matrix
SHUT_ROWS = 40  # rows of zero flow within the dead band that are added: it is known to be shut
CENTRES = 60
HIDDEN, STARTS = (24, 24), 3
Predict = Callable[[FloatArray], tuple[FloatArray, FloatArray]]  # inputs (n, 2) -> mean, sd
Fit = Callable[[FloatArray, FloatArray], Predict]


@dataclass(frozen=True)
class OneEdge:
    """A regressor of one valve behind the scaling of its inputs (2,) and of its flow."""

    middle: FloatArray
    size: FloatArray
    unit_m3s: float
    predict: Predict

    def flow(self, w_v: ArrayLike, dp_pa: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation, m3/s."""
        w, dp = np.broadcast_arrays(np.asarray(w_v, float), np.asarray(dp_pa, float))
        inputs = np.column_stack([w, np.sign(dp) * np.sqrt(np.abs(dp))])
        mean, sd = self.predict((inputs - self.middle) / self.size)
        return self.unit_m3s * mean, self.unit_m3s * sd


class Regressor:
    """One of them."""

    def __init__(self, name: str, fit: Fit, has_sd: bool = False, rows: int = MOST_ROWS) -> None:
        self._name, self._fit, self._has_sd, self._rows = name, fit, has_sd, rows

    def name(self) -> str:
        """Its row."""
        return self._name

    def learn(self, train: Record) -> Learned:
        """A regressor per valve, beside the moduli of the linear fit."""
        front = Front(train)
        linear = fitted(front, bases(front.samples))
        edges = self._edges(front, linear.beta_pa)

        def flow(edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
            return edges[edge].flow(w_v, dp_pa)[0]

        def sd(edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
            return edges[edge].flow(w_v, dp_pa)[1]

        return Learned(
            lambda test: predicted(test, flow, linear.beta_pa),
            flow, sd if self._has_sd else None, linear.beta_pa, linear.beta_sd_pa,
        )  # fmt: skip

    def _edges(self, front: Front, beta_pa: FloatArray) -> dict[str, OneEdge]:
        at, edges = front.rows(), {}
        needed = at.moved + at.volume * at.rate / beta_pa
        for c in range(needed.shape[1]):
            for e in at.edges_of(c):
                rows = np.flatnonzero(at.open(e) & at.steady)
                rows = rows[:: max(1, len(rows) // self._rows)]
                inputs = np.column_stack([at.w_v[rows, e], at.root[rows, e]])
                flow = at.sign[c, e] * needed[rows, c]
                edges[at.machine.edges[e].name] = self._one(inputs, flow)
        return edges

    def _one(self, inputs: FloatArray, flow_m3s: FloatArray) -> OneEdge:
        shut = np.linspace(0.8, 1.0, SHUT_ROWS)[:, None] * [1.2, 0.0]
        shut[:, 1] = np.linspace(inputs[:, 1].min(), inputs[:, 1].max(), SHUT_ROWS)
        inputs, flow = np.vstack([inputs, shut]), np.append(flow_m3s, np.zeros(SHUT_ROWS))
        middle, size, unit = inputs.mean(axis=0), inputs.std(axis=0), float(flow.std())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            predict = self._fit((inputs - middle) / size, flow / unit)
        return OneEdge(middle, size, unit, predict)


def _plain(mean: Callable[[FloatArray], FloatArray]) -> Predict:
    """Without a deviation."""
    return lambda x: (np.asarray(mean(x)), np.zeros(len(x)))


def rbf_network(x: FloatArray, y: FloatArray) -> Predict:
    """Centres by k-means, of the width of the distance between neighbours times two."""
    centres = KMeans(CENTRES, n_init=1, random_state=0).fit(x).cluster_centers_
    far = np.sort(np.linalg.norm(centres[:, None] - centres, axis=2), axis=1)
    widths = 2.0 * far[:, 1:4].mean(axis=1)

    def columns(at: FloatArray) -> FloatArray:
        square = ((at[:, None] - centres) ** 2).sum(axis=2)
        return np.hstack([at, np.exp(-0.5 * square / widths**2)])

    model = RidgeCV(np.geomspace(1e-6, 1e-1, 11)).fit(columns(x), y)
    return _plain(lambda at: model.predict(columns(at)))


def grnn(x: FloatArray, y: FloatArray) -> Predict:
    """Weighted mean of the rows, the width by leave-one-out over a grid."""
    square = ((x[:, None] - x) ** 2).sum(axis=2)
    best, width = np.inf, 0.1
    for trial in np.geomspace(0.01, 0.5, 14):
        weight = np.exp(-0.5 * square / trial**2) + 1e-300
        np.fill_diagonal(weight, 0.0)
        error = float(np.mean((weight @ y / np.maximum(weight.sum(axis=1), 1e-300) - y) ** 2))
        best, width = (error, trial) if error < best else (best, width)

    def mean(at: FloatArray) -> FloatArray:
        parts = []
        for k in range(0, len(at), 2000):
            far = ((at[k : k + 2000, None] - x) ** 2).sum(axis=2)
            weight = np.exp(-0.5 * (far - far.min(axis=1, keepdims=True)) / width**2)
            parts.append(weight @ y / weight.sum(axis=1))
        return np.concatenate(parts)

    return _plain(mean)


def lssvm(x: FloatArray, y: FloatArray) -> Predict:
    """Kernel ridge, cross-validated."""
    grid = {"alpha": np.geomspace(1e-5, 1e-2, 4), "gamma": np.geomspace(0.1, 3.0, 5)}
    search = GridSearchCV(KernelRidge(kernel="rbf"), grid, cv=4).fit(x, y)
    return _plain(search.best_estimator_.predict)


def gaussian_process(x: FloatArray, y: FloatArray) -> Predict:
    """Squared exponential with two lengths, and noise."""
    kernel = ConstantKernel(10.0, (1e-1, 1e4)) * RBF([1.0, 1.0], (0.05, 50.0)) + WhiteKernel(
        1e-4, (1e-8, 1e-1)
    )
    model = GaussianProcessRegressor(kernel, n_restarts_optimizer=0, random_state=0).fit(x, y)
    noise = float(model.kernel_.k2.noise_level)

    def predict(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        parts = [model.predict(at[k : k + 2000], return_std=True) for k in range(0, len(at), 2000)]
        mean, sd = (np.concatenate(part) for part in zip(*parts, strict=True))
        return mean, np.sqrt(np.maximum(sd**2 - noise, 0.0))

    return predict


def neural_net(x: FloatArray, y: FloatArray) -> Predict:
    """The start that errs least on each fifth row, fitted to the others."""
    held_out = np.arange(len(x)) % 5 == 0
    nets = [
        MLPRegressor(hidden_layer_sizes=HIDDEN, activation="tanh", solver="lbfgs", alpha=1e-5,
                     max_iter=600, random_state=k).fit(x[~held_out], y[~held_out])
        for k in range(STARTS)
    ]  # fmt: skip
    best = min(nets, key=lambda net: float(np.mean((net.predict(x[held_out]) - y[held_out]) ** 2)))
    return _plain(best.predict)


METHODS = (
    Regressor("RBF network", rbf_network, rows=3000),
    Regressor("GRNN", grnn, rows=1500),
    Regressor("LSSVM", lssvm),
    Regressor("Gaussian process", gaussian_process, True),
    Regressor("neural net", neural_net, rows=3000),
)
