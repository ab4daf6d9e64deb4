"""Methods for plants by equations: as given, fitted by scipy, and without equations at all.

equations as given   the free run with the values that their file starts from
output error, given equations   scipy's trust region from ten drawn starts, soft-l1 loss
NARX net             y_k from two past outputs and inputs by a neural net, run freely
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.optimize import least_squares
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor

from benchmarks.missing.record import Learned, Record
from rtid.plain import FloatArray
from rtid.plants.plant import PlantRecord
from rtid.plants.simulator import Simulator

STARTS, SUB_STEPS = 10, 4
HIDDEN, NETS, ORDER = (20, 20), 3, 2
FAR = 1e6  # of an output that has left every range


def simulated(record: Record, values: FloatArray) -> FloatArray:
    """Outputs (n, p) of the free run with values of the unknowns."""
    plant = record.plant_file.plant
    n = len(plant.inputs)
    still = np.zeros((len(record.t_s), len(plant.outputs)))
    run = Simulator(plant, PlantRecord(record.t_s, record.values[:, :n], still), SUB_STEPS)
    return np.asarray(run.run(values[:, None])[0][:, :, 0])


class AsGiven:
    """The baseline."""

    def name(self) -> str:
        """Its row."""
        return "equations as given"

    def learn(self, train: Record) -> Learned:
        """Nothing."""
        values = np.array([p.start for p in train.plant_file.plant.unknowns], float)
        return Learned(lambda test: simulated(test, values))


class GivenFitted:
    """The given equations, fitted."""

    def name(self) -> str:
        """Its row."""
        return "output error, given equations"

    def learn(self, train: Record) -> Learned:
        """The best of several starts."""
        plant = train.plant_file.plant
        unknowns, y = plant.unknowns, train.values[:, len(plant.inputs) :]
        low, high = (
            np.array([getattr(p, end) for p in unknowns], float) for end in ("low", "high")
        )
        first = np.clip(np.array([p.start for p in unknowns], float), low, high)
        scale, spread = np.maximum(np.abs(first), 0.01 * (high - low)), y.std(axis=0)
        rng = np.random.default_rng(0)

        def miss(values: FloatArray) -> FloatArray:
            out = np.nan_to_num((simulated(train, values) - y) / spread, nan=FAR)
            return np.clip(out, -FAR, FAR).ravel()

        best, values = np.inf, first
        for k in range(STARTS):
            start = first * np.exp(0.5 * (k > 0) * rng.standard_normal(len(first)))
            start = np.clip(start, low + 1e-9, high - 1e-9)
            fit = least_squares(miss, start, bounds=(low, high), x_scale=scale, max_nfev=60)
            if fit.cost < best:
                best, values = fit.cost, fit.x
        return Learned(lambda test: simulated(test, values))


class NarxNet:
    """No equations: a net of past outputs and inputs."""

    def name(self) -> str:
        """Its row."""
        return "NARX net"

    def learn(self, train: Record) -> Learned:
        """The net whose free run over the training record is best."""
        n = len(train.plant_file.plant.inputs)
        u, y = train.values[:, :n], train.values[:, n:]
        at, size = train.values.mean(axis=0), np.maximum(train.values.std(axis=0), 1e-12)
        both = (train.values - at) / size
        inputs = np.hstack([both[ORDER - 1 - k : len(u) - 1 - k] for k in range(ORDER)])
        target = both[ORDER:, n:] - both[ORDER - 1 : -1, n:]
        nets = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            for seed in range(NETS):
                net = MLPRegressor(hidden_layer_sizes=HIDDEN, activation="tanh", solver="lbfgs",
                                   alpha=1e-3, max_iter=800, random_state=seed)  # fmt: skip
                nets.append(net.fit(inputs, target if target.shape[1] > 1 else target[:, 0]))

        def run(net: MLPRegressor, inputs_of: FloatArray) -> FloatArray:
            scaled = (inputs_of - at[:n]) / size[:n]
            out = np.tile(both[0, n:], (len(scaled), 1))
            for k in range(ORDER, len(scaled)):
                past = [np.append(scaled[k - 1 - j], out[k - 1 - j]) for j in range(ORDER)]
                step = np.ravel(net.predict(np.concatenate(past)[None, :]))
                out[k] = np.clip(out[k - 1] + step, -10.0, 10.0)
            return out * size[n:] + at[n:]

        best = min(nets, key=lambda net: float(np.mean((run(net, u) - y) ** 2)))
        return Learned(lambda test: run(best, test.values[:, :n]))


METHODS = (AsGiven(), GivenFitted(), NarxNet())
