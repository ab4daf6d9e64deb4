"""A pressure between the samples of a slow log, against what is known in a hundredth of a step."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_bridge.samples import GAP, ROW
from rtid.diagnose.evidence import rows_of
from rtid.effects.record_view import MapTerms, RecordView
from rtid.estimator.state import Weights, nominal_weights
from rtid.kernels.layout import TERMS
from rtid.kernels.taking import STRAIGHT_S, UNSURE
from rtid.model import Lag, Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model, uniform_grid
from rtid.sim.simulated_plant import SimulatedPlant

N, FINE, SLOPE = 4000, 100, 1e-11  # samples; parts of a step; dQ/ddp of the map, m3/s/Pa
U_V, P_S, MIDDLE = 5.0, 7e6, 3.5e6
GRID = uniform_grid((1.0, 10.0, 3), (0.0, 7e6, 4))
MODEL = declared_model(SimulatedPlant(), grid=GRID, lag=Lag(0.0, 0.0))
NO_COV = np.zeros((0, TERMS, TERMS))


def known(bends: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """p_a (n,) at the samples, and its means (n - 1,) over the steps; bends (n,): dp/dt, fine."""
    p = MIDDLE + np.concatenate([[0.0], np.cumsum(bends)]) * dt_s / FINE
    inside = 0.5 * (p[1:] + p[:-1])
    return p[::FINE], inside.reshape(-1, FINE).mean(axis=1)


def chunk_of(p_a: FloatArray, dt_s: float) -> FloatArray:
    """A record (n, 2 + signals), SI, at one position, in which that pressure moves alone."""
    model, chunk = MODEL, np.zeros((len(p_a), 2 + len(MODEL.signals)))
    chunk[:, 0], chunk[:, 1], chunk[0, 1] = dt_s * np.arange(len(p_a)), ROW, ROW | GAP
    level: dict[str, float] = {"u": U_V, "p_b": MIDDLE, "p_supply": P_S, "x": 0.25}
    for name, value in level.items():
        chunk[:, 2 + model.column(name)] = value
    chunk[:, 2 + model.column("p_a")] = p_a
    return chunk


def flow_over(model: Machine, chunk: FloatArray) -> FloatArray:
    """Mean flow of the first edge (n - 1,), m3/s, by a map that is SLOPE dp everywhere."""
    edge, cells = model.edges[0], np.arange(GRID.shape[0] * GRID.shape[1])
    drop = np.tile(0.5 * (GRID.dp_pa[1:] + GRID.dp_pa[:-1]), GRID.shape[0])
    terms = np.zeros((len(cells), TERMS))
    terms[:, 0] = SLOPE * drop / edge.rated_q_m3s
    terms[:, 2] = SLOPE * 0.5 * np.diff(GRID.dp_pa)[0] / edge.rated_q_m3s
    weights = nominal_weights(model)
    return RecordView.of(model, chunk, weights, MapTerms(cells, terms, NO_COV)).flow(0)


def missed(bends: FloatArray, dt_s: float) -> FloatArray:
    """What the flow over each step (n - 1,) is off by, as a pressure, Pa."""
    p, mean = known(bends, dt_s)
    return flow_over(MODEL, chunk_of(p, dt_s)) / SLOPE - (P_S - mean)


def turned(seed: int) -> FloatArray:
    """A rate of 10 MPa/s (n,), fine, that turns at an instant of its own every ten steps."""
    rng, n = np.random.default_rng(seed), (N - 1) * FINE
    at = np.arange(5 * FINE, n, 10 * FINE)
    turns = at + rng.integers(0, FINE, len(at))
    signs = np.where(np.searchsorted(turns, np.arange(n)) % 2 == 0, 1.0, -1.0)
    return 1e7 * signs


@pytest.mark.parametrize("dt_s", [5e-3, 10e-3])
def test_a_swing_that_the_samples_follow_is_no_line_between_them(dt_s: float) -> None:
    """Of 10 Hz: of 5 samples a quarter turn the chord misses 16 kPa, and the rule 0.6."""
    t = dt_s / FINE * np.arange((N - 1) * FINE)
    bends = 1e6 * 20.0 * np.pi * np.cos(20.0 * np.pi * t)
    off = missed(bends, dt_s)[2:-2]
    chord = known(bends, dt_s)
    line = (0.5 * (chord[0][1:] + chord[0][:-1]) - chord[1])[2:-2]
    share = (20.0 * np.pi * dt_s) ** 2
    assert np.abs(line).max() == pytest.approx(1e6 * share / 12.0, rel=0.05)
    assert np.abs(off).max() < 0.2 * share * np.abs(line).max()


def test_a_turn_at_any_instant_is_right_on_average_and_its_scatter_is_noise() -> None:
    """Sums over each turn: the mean is nothing, the variance a fifth of that of the bend."""
    dt_s = 10e-3
    bends = turned(1)
    off = missed(bends, dt_s)[: (N - 1) // 10 * 10].reshape(-1, 10)
    sums = (off.sum(axis=1) * np.where(np.arange(len(off)) % 2, -1, 1))[1:-1]
    whole = 2e7 * dt_s / 12.0  # of a change of 20 MPa/s
    assert abs(sums.mean()) < 4.0 * sums.std() / np.sqrt(len(sums))
    assert sums.var() == pytest.approx(UNSURE * whole**2, rel=0.15)


def test_rows_are_weighed_for_what_is_unknown_of_a_bend() -> None:
    """A step after a turn tells less than one of a level pressure, and no other step does."""
    dt_s, model = 10e-3, MODEL
    p, _ = known(turned(2), dt_s)
    weights = Weights(np.full(model.n_cells, 10.0 * SLOPE), np.full(2, 1e-9), 0.0)
    bent, level = (
        rows_of(model, chunk_of(values, dt_s), weights).whiten[:, 0]
        for values in (p, np.full(len(p), MIDDLE))
    )
    tells_less = bent < 0.99 * level
    assert 0.1 <= tells_less.mean() <= 0.5  # one turn in ten steps, which two or three steps see


def test_beside_a_gap_and_in_a_log_as_fast_as_controllers_a_pressure_is_a_line() -> None:
    p, _ = known(turned(3), 10e-3)
    fast = chunk_of(p, STRAIGHT_S)
    line = SLOPE * (P_S - 0.5 * (p[1:] + p[:-1]))
    assert flow_over(MODEL, fast) == pytest.approx(line, rel=1e-12)
    slow = chunk_of(p, 10e-3)
    assert np.abs(flow_over(MODEL, slow) - line).max() > 1e-3 * line.max()
    slow[::3, 1] = ROW | GAP  # each step has one beside it
    whole = np.arange(1, len(p)) % 3 != 0
    assert flow_over(MODEL, slow)[whole] == pytest.approx(line[whole], rel=1e-12)
