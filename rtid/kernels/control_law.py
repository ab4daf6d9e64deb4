"""What a position controller wants of the valves: the flows into both chambers.

Feed-forward with P and I on position, and the adaptive robust controller of the paper's neighbour
(Liu and Yao), adaptation off.  With z1 = x - x_d, v_r = v_d - k z1, z2 = v - v_r, and gains k:

    F   = m (dv_r/dt - k z2) + gravity(x) + friction          force that is wanted of the cylinder
    P_d = (F + A_B P_B) / A_A                                  by chamber A
    Q_A = A_A v + V_A / beta (dP_d/dt - k (P_A - P_d)) + leak  flow into A
    Q_B = - A_B v - V_B / beta k_off (P_B - P_off) - leak      keeps B at its low pressure
    leak = c (P_A - P_B), c the internal leakage that the controller knows of
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rtid.kernels.jit import part
from rtid.plain import FloatArray


class Mechanics(NamedTuple):
    """The machine besides its valves as a controller knows it, SI; gravity in mid-stroke."""

    area_a_m2: float
    area_b_m2: float
    stroke_m: float
    v0_a_m3: float
    v0_b_m3: float
    beta_pa: float
    mass_kg: float = 0.0
    gravity_n: float = 0.0
    gravity_slope_npm: float = 0.0
    coulomb_n: float = 0.0
    coulomb_width_mps: float = 4e-3
    viscous_nspm: float = 0.0


class RobustLaw(NamedTuple):
    """The numbers of the adaptive robust controller."""

    c: Mechanics
    gain_1ps: float
    off_gain_1ps: float
    off_side_pa: float
    lead_s: float  # the flows are those of so much later, as far as the reference tells them
    leak_m3spa: float


def resistance(c: Mechanics, x: FloatArray, v: FloatArray) -> FloatArray:
    """Gravity and friction (n,), N, at positions and speeds (n,), as the controller knows them."""
    gravity = c.gravity_n + c.gravity_slope_npm * (x - 0.5 * c.stroke_m)
    return gravity + c.coulomb_n * np.tanh(v / c.coulomb_width_mps) + c.viscous_nspm * v


@part
def wanted_flows(
    law: RobustLaw, x: float, v: float, p_a: float, p_b: float, ref: FloatArray
) -> tuple[float, float]:
    """Q_A and Q_B, m3/s, for what is measured and the reference's x, v, a, jerk (4,), SI."""
    c, k = law.c, law.gain_1ps
    gravity = c.gravity_n + c.gravity_slope_npm * (x - 0.5 * c.stroke_m)
    side = math.tanh(ref[1] / c.coulomb_width_mps)
    friction = c.coulomb_n * side + c.viscous_nspm * v
    a = (p_a * c.area_a_m2 - p_b * c.area_b_m2 - gravity - friction) / c.mass_kg
    v_r, a_r = ref[1] - k * (x - ref[0]), ref[2] - k * (v - ref[1])
    force = c.mass_kg * (a_r - k * (v - v_r)) + gravity + friction
    j_r = ref[3] - k * (a - ref[2])
    rate = c.mass_kg * (j_r - k * (a - a_r)) + c.gravity_slope_npm * v + c.viscous_nspm * a
    rate += c.coulomb_n * (1.0 - side * side) / c.coulomb_width_mps * ref[2]
    off = -law.off_gain_1ps * (p_b - law.off_side_pa)
    p_d = (force + c.area_b_m2 * p_b) / c.area_a_m2
    p_rate = (rate + c.area_b_m2 * off) / c.area_a_m2
    volume_a = c.v0_a_m3 + c.area_a_m2 * x
    volume_b = c.v0_b_m3 + c.area_b_m2 * (c.stroke_m - x)
    soon, leak = v + law.lead_s * ref[2], law.leak_m3spa * (p_a - p_b)
    q_a = c.area_a_m2 * soon + volume_a / c.beta_pa * (p_rate - k * (p_a - p_d)) + leak
    return q_a, -c.area_b_m2 * soon + volume_b / c.beta_pa * off - leak
