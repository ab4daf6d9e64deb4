"""The published map: lapped windows, continuity, slopes, inverse, and honest extrapolation."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rtid.estimator.flowmap import EXTRAPOLATED, LEARNING, PRIOR, SHUT, VALID, EdgeMap, FlowMap
from rtid.estimator.published import cell_terms, publish
from rtid.model import Grid
from rtid.plain import FloatArray
from tests.flow_maps import GRID, RATED_Q_M3S, Flow, compensated, empty, machine, orifice, solved


def learned(seed: int = 1, flow: Flow = orifice, rows: int = 400) -> FlowMap:
    return publish(solved(machine(), flow, np.random.default_rng(seed), rows=rows))


def centres(grid: Grid, chosen: FloatArray) -> tuple[FloatArray, FloatArray]:
    i, j = np.nonzero(chosen)
    u, p = grid.u_v, grid.dp_pa
    return 0.5 * (u[i] + u[i + 1]), 0.5 * (p[j] + p[j + 1])


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


def random_map(seed: int, safe: bool = True) -> EdgeMap:
    """Unequal blocks with wild polynomials."""
    rng = np.random.default_rng(seed)
    u = np.append(0.0, np.cumsum(10.0 ** rng.uniform(-1, 0.5, rng.integers(1, 7))))
    p = np.append(0.0, np.cumsum(10.0 ** rng.uniform(5, 6.5, rng.integers(1, 7)))) - 2e5
    theta = rng.standard_normal((len(u) - 1, len(p) - 1, 6)) * 1e-4
    start = float(rng.uniform(u[0], u[1])) if safe else -np.inf
    return edge_map(Grid(u, p), theta, start)


def edge_map(grid: Grid, theta: FloatArray, safe_band_v: float) -> EdgeMap:
    cov = np.zeros((*grid.shape, 6, 6))
    return EdgeMap("e", grid, safe_band_v, theta, cov, np.full(grid.shape, VALID), {})


def rising_map(seed: int, dp_pa: FloatArray) -> EdgeMap:
    """A rising plane, bent and disturbed as far as it rises at the given pressure drops."""
    rng, edge = np.random.default_rng(seed), random_map(seed)
    grid, start = edge.grid, edge.safe_band_v
    curve, exponent = rng.uniform(0, 0.3), rng.uniform(0.3, 1.0)

    def bent(w: FloatArray, dp: FloatArray) -> FloatArray:
        return 1e-4 * (w + curve * w * w) * np.sign(dp) * np.abs(dp / 1e6) ** exponent

    plane = cell_terms(grid, lambda w, dp: 1e-4 * w * (1 + dp / 1e6))
    plane = plane.reshape(edge.theta.shape)
    other = cell_terms(grid, bent).reshape(edge.theta.shape) - plane
    other[:, :, 0] += 1e-6 * rng.standard_normal(grid.shape)
    shares = (*0.5 ** np.arange(8.0), 0.0)
    maps = (edge_map(grid, plane + share * other, start) for share in shares)
    return next(edge for edge in maps if rises(edge, dp_pa))


def rises(edge: EdgeMap, dp_pa: FloatArray) -> bool:
    near = edge.safe_band_v + np.diff(edge.grid.u_v).min() * np.geomspace(1e-6, 0.1, 20)
    w = np.concatenate([_fine(edge.grid.u_v), near])
    w = w[(w > edge.safe_band_v) & (w <= edge.grid.u_v[-1]), None]
    return bool((edge.gradient(w, dp_pa)[0] > 0).all())


def _fine(border: FloatArray) -> FloatArray:
    return np.unique(np.concatenate([np.linspace(*pair, 41) for pair in pairwise(border)]))


@example(15188, True)  # a foot of 0.03 V: its slope moved by 1e-12 within a step of the grid's
@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=60, deadline=None)
def test_nothing_jumps_at_the_borders(seed: int, safe: bool) -> None:
    """Q and both slopes on either side of every border and of the safe band: equal to rounding."""
    edge = random_map(seed, safe)
    u, p = edge.grid.u_v, edge.grid.dp_pa
    rng = np.random.default_rng(seed)
    starts = [edge.safe_band_v] if safe else []
    narrowest_v = np.diff(np.unique([*u, *starts])).min()  # the foot behind the band bends most
    h_v = max(1e-12 * narrowest_v, 4.0 * float(np.spacing(u[-1])))
    h_pa = 1e-12 * np.diff(p).min()
    scale = (1e-4, 1e-4 / np.diff(u).min(), 1e-4 / np.diff(p).min())
    w, dp = rng.uniform(u[0], u[-1], 50), rng.uniform(p[0], p[-1], 50)
    pairs = [((at - h_v, dp), (at + h_v, dp)) for at in [*u[1:-1], *starts]]
    pairs += [((w, at - h_pa), (w, at + h_pa)) for at in p[1:-1]]
    for sides in pairs:
        below, above = ((edge.flow(*at), *edge.gradient(*at)) for at in sides)
        for x, y, size in zip(below, above, scale, strict=True):
            np.testing.assert_allclose(x, y, rtol=0, atol=2e-9 * size)


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=60, deadline=None)
def test_gradient_equals_finite_differences(seed: int, safe: bool) -> None:
    """To 1e-6 of the largest slope."""
    edge = random_map(seed, safe)
    rng = np.random.default_rng(seed + 1)
    u, p = edge.grid.u_v, edge.grid.dp_pa
    h_v, h_pa = 1e-5 * np.diff(u).min(), 1e-5 * np.diff(p).min()
    w = rng.uniform(u[0] + h_v, u[-1] - h_v, 300)
    dp = rng.uniform(p[0] + h_pa, p[-1] - h_pa, 300)
    by_w, by_dp = edge.gradient(w, dp)
    found_w = (edge.flow(w + h_v, dp) - edge.flow(w - h_v, dp)) / (2 * h_v)
    found_dp = (edge.flow(w, dp + h_pa) - edge.flow(w, dp - h_pa)) / (2 * h_pa)
    np.testing.assert_allclose(found_w, by_w, rtol=0, atol=1e-6 * 1e-3 / np.diff(u).min())
    np.testing.assert_allclose(found_dp, by_dp, rtol=0, atol=1e-6 * 1e-3 / np.diff(p).min())


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=100, deadline=None)
def test_inverse_gives_back_the_command(seed: int) -> None:
    """To 1e-9 of the command's range, from the foot at the safe band to the end of the grid."""
    rng, grid = np.random.default_rng(seed), random_map(seed).grid
    lowest, highest = (0.0, grid.dp_pa[-1]) if grid.dp_pa[-1] > 0 else grid.dp_pa[[0, -1]]
    dp = rng.uniform(lowest, highest, 90 + len(grid.u_v))
    edge = rising_map(seed, dp)
    u, start = edge.grid.u_v, edge.safe_band_v
    foot = start + (u[1] - start) * 10.0 ** -rng.uniform(0, 4, 30)
    w = np.concatenate([foot, rng.uniform(start, u[-1], 60), u[1:], [start]])
    tolerance = 1e-9 * (u[-1] - u[0])
    np.testing.assert_allclose(edge.inverse(edge.flow(w, dp), dp), w, rtol=0, atol=tolerance)
    beyond = edge.flow(u[-1], dp) * 1.0001
    assert np.isnan(edge.inverse(beyond, dp)).all()
    assert np.isnan(edge.inverse(-beyond, dp)).all()


def test_inverse_of_a_map_that_falls() -> None:
    """At negative pressure drops the flow falls with the command."""
    grid = Grid(np.linspace(0, 8, 9), np.linspace(-2e6, 2e6, 5))
    terms = cell_terms(grid, lambda w, dp: 1e-4 * w * dp / 1e6).reshape(8, 4, 6)
    edge = edge_map(grid, terms, 0.5)
    w, dp = np.meshgrid(np.linspace(0.6, 8, 40), [-1.9e6, -0.7e6, 0.3e6])
    np.testing.assert_allclose(edge.inverse(edge.flow(w, dp), dp), w, atol=8e-9)
    assert np.isnan(edge.inverse(0.0, 0.0))
    assert edge.inverse(0.0, 1e6) == pytest.approx(0.5, abs=1e-9)


def test_inverse_of_many_points_is_that_of_each() -> None:
    edge = learned()[0]
    rng = np.random.default_rng(0)
    w, dp = rng.uniform(2.6, 7.9, (3, 3000)), rng.uniform(1e6, 6e6, (3, 3000))
    found = edge.inverse(edge.flow(w, dp), dp)
    np.testing.assert_allclose(found, w, atol=7e-9)
    assert found[1, 7] == edge.inverse(edge.flow(w[1, 7], dp[1, 7]), dp[1, 7])


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
