"""Look-up tables of published maps: as close as asked for, with the map's statuses and inverse."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_bridge.lookup import NONE, STATUS
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.inverse import on_lattice
from rtid.estimator.published import publish
from rtid.maps.lookup import NoTableError, on_wire, sample
from rtid.model import Machine
from tests.flow_maps import compensated, machine, orifice, solved


@pytest.fixture(scope="module", params=[orifice, compensated], ids=["orifice", "compensated"])
def made(request: pytest.FixtureRequest) -> tuple[Machine, FlowMap]:
    model = machine()
    return model, publish(solved(model, request.param, np.random.default_rng(0)))


@pytest.mark.parametrize("percent", [1.0, 0.3, 0.1])
def test_the_table_follows_the_map(made: tuple[Machine, FlowMap], percent: float) -> None:
    (edge,), (published,) = made[0].edges, made[1].edges
    found, rng = sample(edge, published, percent), np.random.default_rng(7)
    w = rng.uniform(edge.grid.u_v[0], edge.grid.u_v[-1], 100_000)
    dp = rng.uniform(edge.grid.dp_pa[0], edge.grid.dp_pa[-1], 100_000)
    dp[:20_000] *= 1e-2  # steep near zero
    off = np.abs(found.table.flow(w, dp)[0] - published.flow(w, dp)) / edge.rated_q_m3s
    nu, ns = found.table.counts.shape
    print(f"\n{percent} % asked: {100 * off.max():.3f} % at {nu} x {ns} nodes, "
          f"rms {100 * np.sqrt(np.mean(off**2)):.3f} %")  # fmt: skip
    assert 100 * off.max() <= percent
    assert found.error_max_m3s == pytest.approx(off.max() * edge.rated_q_m3s, rel=0.35)


def test_statuses_are_those_of_the_map(made: tuple[Machine, FlowMap]) -> None:
    (edge,), (published,) = made[0].edges, made[1].edges
    table, rng = sample(edge, published).table, np.random.default_rng(8)
    w, dp = rng.uniform(0, 8, 20_000), rng.uniform(-0.5e6, 7e6, 20_000)
    words = np.array(STATUS)[table.flow(w, dp)[1]]
    assert (words == published.status_at(w, dp)).mean() > 0.9999


def test_the_inverse_is_that_of_the_map(made: tuple[Machine, FlowMap]) -> None:
    (edge,), (published,) = made[0].edges, made[1].edges
    table, rng = sample(edge, published).table, np.random.default_rng(9)
    w, dp = rng.uniform(2.0, 8.0, 5000), rng.uniform(0.1e6, 7e6, 5000)
    q = published.flow(w, dp)
    exact, (u, status) = published.inverse(q, dp), table.command(q, dp)
    both = np.isfinite(exact) & (status != NONE)
    assert both.mean() > 0.9 * np.isfinite(exact).mean()
    reached = published.flow(u[both], dp[both])
    assert np.abs(reached - q[both]).max() < 2e-3 * edge.rated_q_m3s


def test_a_machine_without_safe_band() -> None:
    model = machine(safe_band_v=-np.inf)
    (published,) = publish(solved(model, orifice, np.random.default_rng(0))).edges
    found = sample(model.edges[0], published, 0.3)
    assert found.error_max_m3s <= 3e-3 * model.edges[0].rated_q_m3s
    assert STATUS[found.table.flow(0.5, 1e6)[1]] == "outside"


def test_less_room_costs_accuracy_and_too_little_is_refused(made: tuple[Machine, FlowMap]) -> None:
    (edge,), (published,) = made[0].edges, made[1].edges
    close = sample(edge, published, 0.1)
    rough = sample(edge, published, 0.1, lambda nu, ns: nu * ns <= 900)
    assert rough.table.counts.size <= 900 < close.table.counts.size
    assert rough.error_max_m3s > close.error_max_m3s
    with pytest.raises(NoTableError, match="do not fit"):
        sample(edge, published, 0.1, lambda nu, ns: nu * ns <= 100)
    assert on_wire(200, 100) and on_wire(255, 255) and not on_wire(256, 3)


def test_a_map_on_a_lattice_is_the_map(made: tuple[Machine, FlowMap]) -> None:
    (edge,), (published,) = made[0].edges, made[1].edges
    w, dp = np.linspace(1.0001, 8.0, 90), np.linspace(-0.5e6, 7e6, 70)
    exact = published.flow(w[:, None], dp)
    q = on_lattice(edge.grid, published.safe_band_v, published.theta, w, dp)
    np.testing.assert_allclose(q, exact, atol=1e-12 * np.abs(exact).max())
