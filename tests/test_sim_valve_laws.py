"""Valves of ten laws: every flow rises with command and pressure drop, and none but one is odd."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.sim.random_plants import draw
from rtid.sim.simulated_plant import EDGES
from rtid.sim.valve_laws import LAWS

DP_PA = np.concatenate([-np.geomspace(5e6, 1e4, 40), [0.0], np.geomspace(1e4, 5e6, 40)])
W_V = np.linspace(0.0, 10.0, 101)


@pytest.mark.parametrize("law", LAWS)
def test_flow_rises_with_command_and_pressure_drop(law: str) -> None:
    plant = draw(3, law=law)
    for edge in EDGES[:4]:
        q = plant.flow(edge, W_V[:, None], DP_PA)
        assert (np.diff(q, axis=1) >= -1e-12).all()
        assert (np.diff(q * np.sign(DP_PA), axis=0) >= -1e-12).all()
        assert q[-1, -1] > 1e-5 and (q[W_V < 1.0] == 0.0).all()
        assert (law == "asymmetric") == (not np.allclose(q, -q[:, ::-1]))


@pytest.mark.parametrize("law", LAWS[1:])
def test_no_other_law_is_an_orifice(law: str) -> None:
    """By more than 0.5 % of the largest flow, for a gain that is fitted to it."""
    other, orifice = (draw(3, law=k).flow("pa", W_V[:, None], DP_PA) for k in (law, "orifice"))
    size = np.vdot(orifice, other) / np.vdot(orifice, orifice)
    assert np.abs(other - size * orifice).max() > 0.005 * np.abs(other).max()
