"""Maps that work within the noise of dp: rows are weighed by the slope of the valve itself."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from firmware_bridge.samples import ROW
from rtid.diagnose.fit import MATCH_RHO, fit, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.steepness import smoothed, with_own_slopes
from rtid.estimator.record import refined, summed
from rtid.estimator.refine import halved_along
from rtid.estimator.solution import sketch
from rtid.model import Grid, Lag, Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.random_plants import draw
from tests.diagnose.records import noisy, record

SD_PA, SD_M, STEP_S, N = 15e3, 15e-6, 1e-3, 30_000
BETA_PA, SUPPLY_PA, GAIN = 9e8, 12e6, 6e-8  # of Q = GAIN w sqrt(dp), w in V
GRID = Grid(np.arange(1.0, 7.5, 0.5), np.array([-2.8e5, 0.0, 1.74e5, 6.9e5]))


@cache
def nearly_open(sd_pa: float = SD_PA) -> tuple[Machine, FloatArray, FloatArray]:
    """A chamber filled at a drop of 17 to 103 kPa, as by a valve that meters out: chunk (n, 2 + s).

    And the true drop (n,), Pa.
    """
    model = declared_model(draw(3), seed=3, grid=GRID)
    chamber = replace(model.chambers[0], area_m2=1.26e-3, v0_m3=3e-4)
    edges = tuple(e for e in model.edges if e.name == "pa")
    noise = {"p_supply": sd_pa, "p_a": sd_pa, "x": SD_M}
    signals = tuple(
        replace(s, noise=noise.get(s.name, 0.0), resolution=0.0, minimum=-np.inf, maximum=np.inf)
        for s in model.signals
    )
    model = replace(model, signals=signals, chambers=(chamber,), edges=edges, lag=Lag(0.0, 0.0))
    t_s = STEP_S * np.arange(N)
    u_v = 4.0 + 2.5 * np.sin(2.0 * np.pi * 0.31 * t_s)
    drop = 60e3 * (1.0 + 0.12 * np.sin(2.0 * np.pi * 0.83 * t_s))
    drop += 36e3 * np.sin(2.0 * np.pi * 0.31 * t_s)
    middle = 0.5 * (drop[1:] + drop[:-1])  # the command is held
    moved = [0.0]
    for u, dp, rise in zip(u_v, middle, -np.diff(drop), strict=False):
        volume = chamber.v0_m3 + chamber.area_m2 * moved[-1]
        flow = GAIN * u * np.sqrt(dp) * STEP_S - volume * rise / BETA_PA
        moved.append(moved[-1] + flow / chamber.area_m2)
    true = {"u": u_v, "p_supply": SUPPLY_PA, "p_a": SUPPLY_PA - drop, "x": np.array(moved)}
    rng, columns = np.random.default_rng(5), [t_s, np.full(N, float(ROW))]
    columns += [true.get(s.name, 0.0) + s.noise * noisy(rng, N) for s in signals]
    return model, np.column_stack(columns), drop


def test_rows_are_weighed_by_the_slope_of_the_valve() -> None:
    """At 21 kPa of noise least squares told half the slope: rho 1.2 where nothing is missing.

    What is left of it is beside flattened slopes as well, so that the valve's tell too much noise.
    """
    model, chunk, drop = nearly_open()
    flat = refined(model, sketch(model, summed(model, chunk)), 0.0)
    both = flat, prepare(model, chunk)
    u = chunk[:, 2 + model.column("u")]
    cells = (np.searchsorted(GRID.u_v, u, side="right") - 1) * GRID.shape[1] + 1
    true = np.sqrt(np.mean((0.5 * GAIN * u) ** 2 / drop))
    shares = [np.sqrt(np.mean(w.slopes[cells] ** 2)) / true for w in both]
    rhos = [fit(model, chunk, w, Revision(), bank=False).rho for w in both]
    print(f"slopes {shares[0]:.2f} and {shares[1]:.2f} of the valve's, rho {rhos}")
    assert shares[0] < 0.6 and 0.65 < shares[1] < 1.1
    assert rhos[0] > MATCH_RHO > rhos[1] > 0.75


def test_a_map_far_above_the_noise_of_dp_is_weighed_as_before() -> None:
    model, chunk, _ = record()
    weights = refined(model, sketch(model, summed(model, chunk)), model.lag.nominal_s)
    assert with_own_slopes(model, chunk, weights) is weights


def test_no_interval_is_halved_below_the_noise_of_dp() -> None:
    """Where the noise would flatten the slopes of either half by more than a tenth."""
    model, _, _ = nearly_open()
    after = halved_along(model, 1).edges[0].grid.dp_pa  # halves of 140, 87 and 258 kPa
    assert after == pytest.approx([-2.8e5, 0.0, 1.74e5, 4.32e5, 6.9e5])
    signals = tuple(replace(s, noise=0.1 * s.noise) for s in model.signals)
    assert len(halved_along(replace(model, signals=signals), 1).edges[0].grid.dp_pa) == 7


def test_smoothing_loses_the_noise_and_keeps_the_steps() -> None:
    """Each value by the longest window that agrees with the shorter ones."""
    rng, true = np.random.default_rng(2), np.where(np.arange(4000) % 400 < 200, 0.0, 30.0)
    off = smoothed(true + noisy(rng, 4000), 1.0) - true
    from_step = np.abs((np.arange(4000) + 100) % 200 - 100)
    assert np.sqrt(np.mean(off[from_step > 20] ** 2)) < 0.5
    assert np.abs(off[from_step < 3]).max() < 4.0, "a step is no steeper where it is smoothed"
    assert np.array_equal(smoothed(true, 0.0), true)
