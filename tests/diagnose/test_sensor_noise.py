"""A floor is made of noise at the rows at which a sensor has measured, on a line between them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rtid.diagnose import attenuation, residual
from rtid.diagnose.fit import Fit
from rtid.diagnose.standing import fitted
from rtid.effects.record_view import RecordView
from rtid.kernels.engine import ROW_FLAG
from rtid.model import Machine
from rtid.plain import FloatArray
from tests.diagnose.records import record

POSITION, PRESSURES = ("x",), ("p_a", "p_b", "p_supply", "p_tank")
K = 5  # samples of 1 ms


def sparse(model: Machine, chunk: FloatArray, names: tuple[str, ...]) -> tuple[Machine, FloatArray]:
    """A record (n, 2 + signals) with signals at every fifth sample, on a line between."""
    thin = chunk.copy()
    for column in (2 + model.column(name) for name in names):
        thin[:, column] = np.interp(chunk[:, 0], chunk[::K, 0], chunk[::K, column])
    if names == POSITION:
        thin[:, 1] = np.where(np.arange(len(chunk)) % K, 0, ROW_FLAG)
        return model, thin
    return replace(model, pressure_period_s=K * 1e-3), thin


@cache
def fit_of_all() -> Fit:
    model, chunk, _ = record()
    return fitted(model, chunk)


@pytest.mark.parametrize("names", [POSITION, PRESSURES])
def test_what_comes_more_rarely_leaves_more_behind_the_filter(names: tuple[str, ...]) -> None:
    """Its noise is that of its rows: 1.8 and 1.5 times the floor, which stayed where it was."""
    fit = fit_of_all()
    model, chunk = sparse(fit.declared, fit.chunk, names)
    every = residual.residual(fit, fit.chunk, everywhere=True).floor_m3s
    rare = residual.residual(replace(fit, declared=model), chunk, everywhere=True).floor_m3s
    assert 1.4 * every < rare < np.sqrt(K) * every


def test_pressures_that_come_rarely_are_drawn_when_they_come() -> None:
    fit = fit_of_all()
    every = attenuation._drawn(fit.view, np.random.default_rng(1))
    view = RecordView.without_map(*sparse(fit.declared, fit.chunk, PRESSURES))
    rare = attenuation._drawn(view, np.random.default_rng(1))
    assert set(rare) == set(every) != set()
    for name, noise in rare.items():
        assert np.array_equal(noise[::K], every[name][::K])
        bends = np.abs(np.diff(noise, 2)) > 1e-6 * noise.std()
        assert bends.sum() <= len(noise) / K


def test_where_every_sample_is_measured_the_noise_is_white() -> None:
    """Bit by bit: nothing that has been judged so far may be judged anew by this."""
    view, rng = fit_of_all().view, np.random.default_rng(1)
    model = view.model
    for name, noise in attenuation._drawn(view, np.random.default_rng(1)).items():
        sensor = model.signals[model.column(name)]
        sd = np.sqrt(sensor.noise**2 + sensor.resolution**2 / 12.0)
        assert np.array_equal(noise, sd * rng.standard_normal(view.n))
