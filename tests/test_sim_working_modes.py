"""The neighbour's choice of valves: which of the five carry the flows that it wants."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from rtid.kernels import look_up
from rtid.plain import FloatArray
from rtid.sim import working_modes
from rtid.sim.robust import sampled
from rtid.sim.sensing import P_A, P_B, P_S, P_T
from rtid.sim.simulated_plant import AB, AT, BT, PA, PB, SimulatedPlant
from rtid.sim.working_modes import LEAST_FLOW_M3S, regenerates

MAPS = sampled(SimulatedPlant().flow)
SUPPLY, TANK = 8.5e6, 1e5
ENDS = {PA: (P_S, P_A), AT: (P_A, P_T), PB: (P_S, P_B), BT: (P_B, P_T), AB: (P_A, P_B)}
Commands = Callable[..., None]


_flow_at, _opening = (njit(part.py_func) for part in (look_up.flow_at, look_up.opening))


def flow_at(edge: int, w_v: float, dp_pa: float) -> float:
    return float(_flow_at(MAPS.w_v[edge], MAPS.s[edge], MAPS.flow_m3s[edge], w_v, dp_pa))


def opening(edge: int, q_m3s: float, dp_pa: float) -> float:
    return float(_opening(MAPS.w_v[edge], MAPS.s[edge], MAPS.flow_m3s[edge], q_m3s, dp_pa))


def seen(p_a: float, p_b: float) -> FloatArray:
    signals = np.zeros(7)
    signals[P_A], signals[P_B], signals[P_S], signals[P_T] = p_a, p_b, SUPPLY, TANK
    return signals


@pytest.fixture(params=["compiled", "python"])
def commands(request: pytest.FixtureRequest) -> Commands:
    kernel: Any = working_modes.commands
    return kernel if request.param == "compiled" else kernel.py_func


@settings(deadline=None)  # the first call compiles
@given(edge=st.sampled_from(sorted(ENDS)), share=st.floats(0.01, 0.99), dp=st.floats(1e5, 9e6))
def test_opening_inverts_the_flow(edge: int, share: float, dp: float) -> None:
    most = flow_at(edge, MAPS.w_v[edge][-1], dp)
    w = opening(edge, share * most, dp)
    assert flow_at(edge, w, dp) == pytest.approx(share * most, rel=1e-9)
    assert opening(edge, 2 * most, dp) == MAPS.w_v[edge][-1]


@pytest.mark.parametrize(
    ("q_a", "q_b", "is_open"),
    [
        (1e-4, -5e-5, {PA, BT}),  # raise
        (1e-4, 5e-5, {PA, PB}),
        (-1e-4, -5e-5, {AT, BT}),
        (-1e-4, 2e-5, {AB, AT}),  # lower: A feeds B
        (-2e-5, 2e-5, {AB}),
        (-6e-4, 3e-4, {AB, AT, PB}),  # more than the cross-port valve can carry
        (LEAST_FLOW_M3S / 2, -LEAST_FLOW_M3S / 2, set()),
    ],
)
def test_the_open_valves_carry_what_is_wanted(
    commands: Commands, q_a: float, q_b: float, is_open: set[int]
) -> None:
    signals, w = seen(3e6, 1.5e6), np.full(5, 9.0)
    commands(MAPS, signals, q_a, q_b, True, w)
    assert set(np.flatnonzero(w)) == is_open
    flow = {
        edge: flow_at(edge, w[edge], signals[source] - signals[sink]) if w[edge] else 0.0
        for edge, (source, sink) in ENDS.items()
    }
    if is_open:
        assert flow[PA] - flow[AT] - flow[AB] == pytest.approx(q_a, rel=1e-6)
        assert flow[PB] - flow[BT] + flow[AB] == pytest.approx(q_b, rel=1e-6)


def test_without_regeneration_the_pump_fills_b(commands: Commands) -> None:
    w = np.zeros(5)
    commands(MAPS, seen(3e6, 1.5e6), -1e-4, 2e-5, False, w)
    assert set(np.flatnonzero(w)) == {AT, PB}


def test_regeneration_has_hysteresis() -> None:
    for kernel in (regenerates, regenerates.py_func):
        assert [kernel(seen(1.5e6 + dp, 1.5e6), before) for dp, before in (
            (0.9e6, False), (0.6e6, True), (0.6e6, False), (0.4e6, True), (-1e6, True)
        )] == [True, True, False, False, False]  # fmt: skip
