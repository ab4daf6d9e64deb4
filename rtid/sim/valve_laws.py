"""Valves that are no plain orifices: what other makers build, Q = f(K(w), dp).

    orifice      K s,  s = dp / (dp^2 + dp_lam^2)^(1/4)
    laminar      K dp / sqrt(a)                               a long gap
    mixed        dp = sqrt(a) Q / K + (Q / K)^2               gap and edge one behind the other
    compensated  K (sqrt(a) x / (1 + x^4)^(1/4) + b s)        x = s / sqrt(a); flow flat beyond a
    choking      K sqrt(a) x / (1 + |x|^12)^(1/12)            cavitates beyond a
    notch        K rises as r^2 up to r = a, b times as fast beyond; at small K as mixed
    asymmetric   K |dp|^b scaled at 2 MPa; b' = 1 - b and a times as much when reversed
    jump         K begins at gain a, as the last of the overlap opens at once
    flow_force   Q / (1 + a |Q| / (4 gain sqrt(2 MPa)))   the jet closes the spool
    overlap      K has a foot of gain a over the last b of the overlap; at small K as mixed

a and b are of each valve, SI.  The shapes of K are in `simulated_plant.flow_gain`.
"""

from __future__ import annotations

import math

import numpy as np

from rtid.sim.compiled import compiled

LAWS = (
    "orifice", "laminar", "mixed", "compensated", "choking",
    "notch", "asymmetric", "jump", "flow_force", "overlap",
)  # fmt: skip
(
    ORIFICE, LAMINAR, MIXED, COMPENSATED, CHOKING,
    NOTCH, ASYMMETRIC, JUMP, FLOW_FORCE, OVERLAP,
) = range(len(LAWS))  # fmt: skip
USUAL_PA = 2e6  # pressure drop at which laws are alike
FINE_PA = 1e6  # from laminar to turbulent in a notch or gap that is hardly open

# least and largest a and b of a valve of each law
RANGES: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "orifice": ((0.0, 0.0), (0.0, 0.0)),
    "laminar": ((1e6, 3e6), (0.0, 0.0)),
    "mixed": ((2e5, 3e6), (0.0, 0.0)),
    "compensated": ((0.4e6, 1.2e6), (0.0, 0.1)),
    "choking": ((1.5e6, 4e6), (0.0, 0.0)),
    "notch": ((0.3, 1.0), (1.5, 3.0)),
    "asymmetric": ((0.5, 0.9), (0.4, 0.62)),
    "jump": ((0.05, 0.4), (0.0, 0.0)),
    "flow_force": ((0.2, 0.8), (0.0, 0.0)),
    "overlap": ((0.02, 0.08), (0.15, 0.4)),
}


def numbers(rng: np.random.Generator, law: str) -> tuple[float, float]:
    """a and b of one valve of a law, SI."""
    (low_a, high_a), (low_b, high_b) = RANGES[law]
    return float(rng.uniform(low_a, high_a)), float(rng.uniform(low_b, high_b))


@compiled
def root_flow(gain: float, dp_pa: float, dp_laminar_pa: float) -> float:
    """Q = K s in m3/s, an orifice laminar below dp_laminar_pa; a shut valve costs no root."""
    if gain == 0.0:
        return 0.0
    return gain * dp_pa / math.sqrt(math.sqrt(dp_pa * dp_pa + dp_laminar_pa * dp_laminar_pa))


@compiled
def mixed_flow(gain: float, dp_pa: float, turns_pa: float) -> float:
    """A gap and an edge one behind the other, m3/s: laminar far below turns_pa."""
    return 2.0 * gain * dp_pa / (math.sqrt(turns_pa) + math.sqrt(turns_pa + 4.0 * abs(dp_pa)))


@compiled
def power_flow(gain: float, dp_pa: float, exponent: float, dp_laminar_pa: float) -> float:
    """K |dp|^exponent, scaled to be the orifice's at USUAL_PA, m3/s."""
    share = (dp_pa * dp_pa + dp_laminar_pa * dp_laminar_pa) / (USUAL_PA * USUAL_PA)
    return gain * dp_pa / math.sqrt(USUAL_PA) * share ** (0.5 * (exponent - 1.0))


@compiled
def bent(q: float, gain: float, turns_pa: float, power: float) -> float:
    """Flow q that bends to be flat where an orifice's drop exceeds turns_pa, m3/s."""
    most = gain * math.sqrt(turns_pa)
    return q / (1.0 + abs(q / most) ** power) ** (1.0 / power)


@compiled
def law_flow(
    law: float, a: float, b: float, unit: float, gain: float, dp_pa: float, dp_laminar_pa: float
) -> float:
    """Q of a law for its flow gain K and pressure drop, m3/s; unit: gain per volt of the valve."""
    q: float = root_flow(gain, dp_pa, dp_laminar_pa)
    if gain == 0.0 or law in (ORIFICE, JUMP):
        return q
    if law == LAMINAR:
        q = gain * dp_pa / math.sqrt(a)
    elif law == MIXED:
        q = mixed_flow(gain, dp_pa, a)
    elif law == NOTCH:
        q = mixed_flow(gain, dp_pa, FINE_PA / (1.0 + (2.0 * gain / (a * unit)) ** 2))
    elif law == OVERLAP:
        q = mixed_flow(gain, dp_pa, FINE_PA / (1.0 + (gain / (a * unit)) ** 2))
    elif law == ASYMMETRIC and dp_pa >= 0.0:
        q = power_flow(gain, dp_pa, b, dp_laminar_pa)
    elif law == ASYMMETRIC:
        q = power_flow(a * gain, dp_pa, 1.0 - b, dp_laminar_pa)
    elif law == COMPENSATED:
        q = bent(q, gain, a, 4.0) + b * q
    elif law == CHOKING:
        q = bent(q, gain, a, 12.0)
    else:  # FLOW_FORCE
        q = q / (1.0 + a * abs(q) / (4.0 * unit * math.sqrt(USUAL_PA)))
    return q
