"""Working modes of the five-valve block: which valves carry the flows that a controller wants.

    Q_A > 0  supply -> A            Q_B > 0  supply -> B
    Q_A < 0  A -> tank              Q_B < 0  B -> tank
    Q_A < 0 < Q_B, P_A above P_B:   A -> B through the cross-port valve, as much as it can carry,
                                    the rest as above: regeneration, the supply is spared

(Liu and Yao, energy-saving programmable valves.)  Regeneration begins above one pressure difference
and ends below a smaller one.  A command is w = Q^-1(|flow|, dp) of that valve's map; a flow too
small to be metered leaves its valves shut.
"""

from __future__ import annotations

from typing import NamedTuple

from rtid.kernels.look_up import flow_at, opening
from rtid.plain import FloatArray
from rtid.sim.compiled import compiled
from rtid.sim.sensing import P_A, P_B, P_S, P_T
from rtid.sim.simulated_plant import AB, AT, BT, PA, PB

LEAST_FLOW_M3S = 5e-7
REGENERATE_ABOVE_PA, REGENERATE_UNTIL_PA = 0.8e6, 0.5e6
CROSS_SHARE = 0.85  # of the cross-port valve's highest command: beyond it, the supply helps


class Maps(NamedTuple):
    """Five look-up tables, in the order of `plant.EDGES`: flow_m3s (nw, ns) rising with w.

    w_v (nw,), s (ns,): nodes of the command and of sqrt(dp in Pa).
    """

    w_v: tuple[FloatArray, ...]
    s: tuple[FloatArray, ...]
    flow_m3s: tuple[FloatArray, ...]


@compiled
def through_cross_port(maps: Maps, seen: FloatArray, q_a: float, q_b: float) -> float:
    """What A gives to B, m3/s, for wanted flows out of A and into B; seen (7,): the sensors, SI."""
    if q_a >= 0.0 or q_b <= 0.0:
        return 0.0
    top_v = CROSS_SHARE * maps.w_v[AB][-1]
    most = flow_at(maps.w_v[AB], maps.s[AB], maps.flow_m3s[AB], top_v, seen[P_A] - seen[P_B])
    q: float = min(q_b, -q_a, most)
    return q if q > LEAST_FLOW_M3S else 0.0


@compiled
def regenerates(seen: FloatArray, before: bool) -> bool:
    """Whether the cross-port valve may open, by the measured pressures of seen (7,), Pa."""
    dp: float = seen[P_A] - seen[P_B]
    return dp > (REGENERATE_UNTIL_PA if before else REGENERATE_ABOVE_PA)


@compiled
def commands(
    maps: Maps, seen: FloatArray, q_a: float, q_b: float, regenerate: bool, w: FloatArray
) -> None:
    """Fill w (5,) in place from the measured signals (7,) and the wanted flows, m3/s."""
    w[:] = 0.0
    p_a, p_b = seen[P_A], seen[P_B]
    if regenerate:
        across = through_cross_port(maps, seen, q_a, q_b)
        if across > 0.0:
            w[AB] = opening(maps.w_v[AB], maps.s[AB], maps.flow_m3s[AB], across, p_a - p_b)
            q_a, q_b = q_a + across, q_b - across
    for q, inlet, outlet, p in ((q_a, PA, AT, p_a), (q_b, PB, BT, p_b)):
        if abs(q) > LEAST_FLOW_M3S:
            edge, dp = (inlet, seen[P_S] - p) if q > 0 else (outlet, p - seen[P_T])
            table = maps.w_v[edge], maps.s[edge], maps.flow_m3s[edge]
            w[edge] = opening(*table, abs(q), dp)
