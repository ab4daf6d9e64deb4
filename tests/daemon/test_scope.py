"""The scope of the live page: nothing that stands out is lost, each tenth of a second is there."""

from __future__ import annotations

import numpy as np

from rtid.daemon.collector import ScopeKeeper
from rtid.daemon.status import Scope


def chunk(t_s: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.stack([t_s, np.zeros_like(t_s), u, -u], axis=1)


def test_a_second_comes_in_tenths_with_every_spike() -> None:
    keeper = ScopeKeeper(("u", "v"))
    t = 5.0 + np.arange(1000) / 1000
    u = np.sin(t)
    u[437] = 9.0
    for part in np.split(np.arange(1000), 5):
        keeper.add(chunk(t[part], u[part]))
    scope = keeper.take()
    assert np.allclose(scope.t_s, 5.0 + np.arange(10) / 10)
    assert scope.high["u"][4] == 9.0 and scope.low["v"][4] == -9.0
    assert np.allclose(scope.low["u"], [u[100 * k : 100 * k + 100].min() for k in range(10)], 1e-4)
    assert keeper.take() == Scope()


def test_a_teller_that_does_not_come_costs_no_memory() -> None:
    keeper = ScopeKeeper(("u", "v"))
    for k in range(1000):
        keeper.add(chunk(np.array([0.2 * k]), np.ones(1)))
    assert len(keeper.take().t_s) <= 30
