"""The published map: lapped windows, continuity, slopes, inverse, and honest extrapolation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.estimator.flowmap import EXTRAPOLATED, LEARNING, PRIOR, SHUT, VALID, FlowMap
from rtid.estimator.published import publish
from rtid.model import FloatArray, Grid
from tests.flow_maps import GRID, RATED_Q_M3S, Flow, compensated, empty, machine, orifice, solved


def learned(seed: int = 1, flow: Flow = orifice, rows: int = 400) -> FlowMap:
    return publish(solved(machine(), flow, np.random.default_rng(seed), rows=rows))


def centres(grid: Grid, chosen: FloatArray) -> tuple[FloatArray, FloatArray]:
    i, j = np.nonzero(chosen)
    u, p = grid.u_v, grid.dp_pa
    return 0.5 * (u[i] + u[i + 1]), 0.5 * (p[j] + p[j + 1])


def test_flow_is_continuous_and_its_gradient_is_its_derivative() -> None:
    edge = learned()[0]
    rng = np.random.default_rng(0)
    w, dp = rng.uniform(1.05, 7.9, 3000), rng.uniform(-0.4e6, 6.9e6, 3000)
    by_w, by_dp = edge.gradient(w, dp)
    h_v, h_pa = 1e-6, 1.0
    np.testing.assert_allclose(
        (edge.flow(w + h_v, dp) - edge.flow(w - h_v, dp)) / (2 * h_v), by_w, atol=2e-8
    )
    np.testing.assert_allclose(
        (edge.flow(w, dp + h_pa) - edge.flow(w, dp - h_pa)) / (2 * h_pa), by_dp, atol=2e-14
    )


def test_raw_polynomials_would_have_jumped() -> None:
    edge = learned()[0]
    inner = GRID.u_v[3:-3]
    above, below = edge.flow(inner + 1e-9, 3e6), edge.flow(inner - 1e-9, 3e6)
    np.testing.assert_allclose(above, below, atol=1e-11)
    theta = edge.theta[:, 7]
    steps = theta[:-1] @ [1, 1, 0, 1, 0, 0] - theta[1:] @ [1, -1, 0, 1, 0, 0]
    assert np.abs(steps).max() > 1e-8


def test_nothing_flows_up_to_the_safe_band_and_nothing_is_known_off_the_grid() -> None:
    edge = learned()[0]
    assert (edge.flow([-5.0, 0.3, 1.0], 3e6) == 0.0).all()
    assert (edge.sd([-5.0, 0.3, 1.0], 3e6) == 0.0).all()
    assert edge.flow(1.0 + 1e-7, 3e6) == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(edge.flow([8.5, 3.0], [3e6, 8e6])).all()
    assert np.isnan(edge.flow(np.nan, 3e6))
    assert edge.status_at([0.5, 9.0, 3.0], [3e6, 3e6, 9e6]).tolist() == [SHUT, "outside", "outside"]


def test_inverse_gives_back_the_command() -> None:
    edge = learned()[0]
    w, dp = np.linspace(2.6, 6.5, 50), np.linspace(1e6, 6e6, 50)
    np.testing.assert_allclose(edge.inverse(edge.flow(w, dp), dp), w, atol=1e-9)


def test_inverse_refuses_what_the_map_cannot_give() -> None:
    edge = learned()[0]
    too_much = 2 * float(edge.flow(7.9, 3e6))
    assert np.isnan(edge.inverse([too_much, -1e-4, np.nan], 3e6)).all()
    assert np.isnan(edge.inverse(1e-4, 9e6))


def test_cells_say_where_they_come_from() -> None:
    model = machine(edges=2)
    rng = np.random.default_rng(3)
    sure, unsure = solved(model, orifice, rng), solved(model, orifice, rng, path=1, rows=30)
    blocks = (*(b for b in sure.blocks if b.edge == 0), *(b for b in unsure.blocks if b.edge == 1))
    first, second = publish(replace(sure, blocks=blocks)).edges
    assert set(np.unique(first.status)) == {VALID, EXTRAPOLATED}
    assert set(np.unique(second.status)) == {LEARNING, EXTRAPOLATED}
    i, j = np.argwhere(second.status == LEARNING)[0].tolist()
    assert second.reason[i, j] == "30 rows, 100 needed"


def test_a_map_without_data_is_the_rated_valve_and_admits_that() -> None:
    edge = publish(empty(machine()))[0]
    assert (edge.status == PRIOR).all()
    assert edge.flow(8.0, 3e6) == pytest.approx(RATED_Q_M3S, rel=0.02)
    assert edge.sd(8.0, 3e6) > RATED_Q_M3S


def test_cells_below_the_safe_band_are_shut() -> None:
    grid = Grid(np.concatenate([[0.0, 0.5], GRID.u_v]), GRID.dp_pa)
    edge = publish(solved(machine(grid), orifice, np.random.default_rng(0)))[0]
    assert (edge.status[:2] == SHUT).all()
    assert not (edge.status[2:] == SHUT).any()


def test_a_valve_without_safe_band_may_flow_everywhere() -> None:
    model = machine(safe_band_v=-np.inf)
    edge = publish(solved(model, orifice, np.random.default_rng(0)))[0]
    dp = np.linspace(1e6, 6e6, 5)
    assert np.isfinite(edge.flow(1.0, dp)).all()
    assert (edge.sd(1.0, dp) > 0).all()


@pytest.mark.parametrize("flow", [orifice, compensated])
def test_intervals_of_cells_without_data_are_honest(flow: Flow) -> None:
    z = []
    for seed in range(12):
        fm = learned(seed, flow, rows=200)
        w, dp = centres(GRID, fm[0].status == EXTRAPOLATED)
        z.append((fm.flow(0, w, dp) - flow(w, dp)) / fm.sd(0, w, dp))
    every = np.concatenate(z)
    assert np.mean(np.abs(every) < 2) > 0.92
    assert 0.4 < np.sqrt(np.mean(every**2)) < 1.3


def test_uncertainty_grows_away_from_the_data() -> None:
    fm = learned(2)
    visited = np.nonzero((fm[0].status == VALID).any(axis=1))[0]
    last = 0.5 * (GRID.u_v[visited[-1]] + GRID.u_v[visited[-1] + 1])
    sd = fm.sd(0, np.linspace(last, 7.9, 6), 3e6)
    assert (np.diff(sd) > 0).all()
    assert sd[-1] > 3 * sd[0]


def test_weakly_excited_terms_come_from_the_law() -> None:
    """At the corners of valid blocks the published map must beat the blocks' own polynomials."""
    raw, published = [], []
    for seed in range(8):
        solution = solved(machine(), orifice, np.random.default_rng(seed), rows=120)
        fm = publish(solution)
        for b in solution.blocks:
            u, p = GRID.u_v[b.i : b.i + 2], GRID.dp_pa[b.j : b.j + 2]
            corner = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
            truth = orifice(u[1:], p[1:])[0]
            raw.append(corner @ b.theta - truth)
            published.append(corner @ fm[0].theta[b.i, b.j] - truth)
    assert np.std(published) < 0.3 * np.std(raw)


def test_theta_cells_are_in_the_order_of_the_kernels() -> None:
    model = machine(edges=2)
    fm = publish(solved(model, orifice, np.random.default_rng(5)))
    nu, nd = GRID.shape
    assert fm.theta_cells().shape == (2 * nu * nd, 6)
    np.testing.assert_array_equal(fm.theta_cells()[nu * nd + 3 * nd + 4], fm["e1"].theta[3, 4])
    with pytest.raises(KeyError, match="no edge 'e7'"):
        fm["e7"]
