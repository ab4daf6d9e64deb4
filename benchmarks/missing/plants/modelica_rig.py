"""A cylinder in Modelica text, compiled and integrated by rumoca: another hand's equations.

The position controller is part of the model and continuous; its command is sampled, and a lag of
1.8 ms behind a continuous command is to rtid one of 1.3 ms behind a held one.  What is hidden is
an equation more.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.missing.plants.valve_records import RECORD_S, Simulated, case_of, noisy
from benchmarks.missing.record import SMALL, Case, Wish
from rtid.plain import FloatArray
from rtid.sim.demand import DT_S, IDENTIFICATION
from rtid.sim.random_plants import draw
from rtid.sim.simulated_plant import Constants, SimulatedPlant

# internal and external leakage in m3/s/Pa, share of air at atmospheric pressure
HIDDEN = {
    "internal_leakage_laminar": 4e-12,
    "external_leakage_laminar": 2e-12,
    "entrained_air": 0.02,
}
HALF_SAMPLE_S = 0.5e-3
VALVES = ("pa", "at", "pb", "bt")
TRIES = 8

MODEL = """
model Cylinder
  parameter Real leak_ab = {leak_ab};
  parameter Real leak_a = {leak_a};
  parameter Real air = {air};
  Real pa(start = {pa0}, fixed = true, nominal = 1e6);
  Real pb(start = {pb0}, fixed = true, nominal = 1e6);
  Real x(start = {x0}, fixed = true);
  Real v(start = 0.0, fixed = true);
  Real wp(start = 0.0, fixed = true);
  Real ps; Real xr; Real vr; Real demand; Real u; Real load;
  Real qpa; Real qat; Real qpb; Real qbt; Real va; Real vb; Real learning;
equation
  learning = if time < {learn_s} then 1.0 else 0.0;
  xr = {middle} + (if time < {learn_s} then {amplitude} * sin(0.628 * time + {slope} * time * time)
    else {amplitude} * (0.7 * sin(1.1 * (time - {learn_s})) + 0.5 * sin(2.3 * time + 0.4)));
  vr = if time < {learn_s} then {amplitude} * (0.628 + 2 * {slope} * time)
      * cos(0.628 * time + {slope} * time * time)
    else {amplitude} * (0.77 * cos(1.1 * (time - {learn_s})) + 1.15 * cos(2.3 * time + 0.4));
  ps = {ps} * (1.0 + {rich} * (0.12 * sin(0.29 * time) + 0.06 * sin(0.81 * time + 1.0)));
  load = {gravity} * (1.0 + {rich} * (0.15 * sin(1.9 * time) + 0.15 * sin(6.1 * time + 2.0)));
  demand = vr + {kp} * (xr - x);
  u = {band} * tanh(demand / 0.004) + {gain} * demand
    + {rich} * learning * (0.3 * sin(11.0 * time) + 0.25 * sin(29.0 * time + 1.0)
    + 0.2 * sin(53.0 * time + 2.0));
  der(wp) = (u - wp) / {lag};
{edges}
  va = {va} + {aa} * x;
  vb = {vb} + {ab} * ({stroke} - x);
  der(pa) * va * (1.0 / {beta} + air * 1e5 / (pa * pa))
    = qpa - qat - {aa} * v - leak_ab * (pa - pb) - leak_a * (pa - {pt});
  der(pb) * vb * (1.0 / {beta} + air * 1e5 / (pb * pb))
    = qpb - qbt + {ab} * v + leak_ab * (pa - pb);
  der(x) = v;
  {mass} * der(v) = pa * {aa} - pb * {ab} - load - {coulomb} * tanh(v / 0.004) - {viscous} * v;
end Cylinder;
"""
EDGE = """  {q} = {k} * (max(0.0, {sign} * wp - {band})^2 / (0.1 + max(0.0, {sign} * wp - {band})))
    * ({dp}) / sqrt(sqrt(({dp}) * ({dp}) + {lam}));"""
ENDS = {"pa": "ps - pa", "at": "pa - {pt}", "pb": "ps - pb", "bt": "pb - {pt}"}
LAMINAR_PA = 3e4


def wishes(size: str) -> Iterator[Wish]:
    """Clean, rich and poor, and three effects."""
    if size == SMALL:
        return
    for motion in ("rich", "poor"):
        yield _wish(motion, "", True)
    for effect in HIDDEN:
        yield _wish("rich", effect, False)


def _wish(motion: str, effect: str, for_all: bool) -> Wish:
    name = " ".join(word for word in ("modelica", "rounded", motion, effect) if word)
    return Wish(name, partial(_draw, name, motion, effect, for_all))


def _draw(name: str, motion: str, effect: str, for_all: bool, seed: int) -> Case | None:
    for number in range(seed, seed + TRIES):
        simulated = run(draw(number), motion, number, effect)
        if simulated is not None:
            return case_of(
                simulated, number, effect, name=name, simulator="Modelica (rumoca)",
                law="rounded", motion=motion, hidden=effect, level="middle" if effect else "",
                for_all=for_all,
            )  # fmt: skip
    return None


def gain(plant: SimulatedPlant, edge: str, w_v: FloatArray) -> FloatArray:
    """K(w) in m3/s/sqrt(Pa): a hyperbola above the dead band."""
    valve = plant.valves[VALVES.index(edge)]
    above = np.maximum(0.0, w_v - valve.deadband_v)
    return np.asarray(valve.gain * above**2 / (0.1 + above))


def text(plant: SimulatedPlant, motion: str, effect: str) -> str:
    """The model of a plant."""
    c: Constants = plant.constants
    edges = []
    for k, (edge, sign) in enumerate(zip(VALVES, (1, -1, -1, 1), strict=True)):
        dp = ENDS[edge].format(pt=plant.p_tank_pa)
        valve = plant.valves[k]
        edges.append(
            EDGE.format(q=f"q{edge}", k=valve.gain, sign=f"{sign}.0", band=valve.deadband_v,
                        dp=dp, lam=LAMINAR_PA**2)
        )  # fmt: skip
    p_b, middle, learn_s = 0.3 * plant.p_supply_pa, 0.5 * c.stroke_m, IDENTIFICATION * RECORD_S
    size = HIDDEN.get(effect, 0.0)
    sizes = {"leak_ab": "internal", "leak_a": "external", "air": "air"}
    hidden = {k: size if word in effect else 0.0 for k, word in sizes.items()}
    return MODEL.format(
        **hidden, edges="\n".join(edges), rich=1.0 if motion == "rich" else 0.0,
        pa0=(c.gravity_n + p_b * c.area_b_m2) / c.area_a_m2, pb0=p_b, x0=middle, middle=middle,
        learn_s=learn_s, amplitude=0.065, slope=0.5 * (3.14 - 0.628) / learn_s,
        ps=plant.p_supply_pa, pt=plant.p_tank_pa, gravity=c.gravity_n, kp=5.0,
        band=plant.controller.deadband_v, gain=plant.controller.volts_per_mps,
        lag=plant.lag_s + HALF_SAMPLE_S, va=c.v0_a_m3, vb=c.v0_b_m3, aa=c.area_a_m2,
        ab=c.area_b_m2, stroke=c.stroke_m, beta=c.beta_pa, mass=c.mass_kg,
        coulomb=c.coulomb_n, viscous=c.viscous_nspm,
    )  # fmt: skip


def run(plant: SimulatedPlant, motion: str, seed: int, effect: str) -> Simulated | None:
    """One record; None where the machine leaves its stroke or cavitates."""
    import rumoca

    model = rumoca.Session().loads(text(plant, motion, effect), model="Cylinder")
    try:
        result = model.simulate(t=RECORD_S, dt=DT_S)
    except rumoca.SimulationError:
        return None
    t_s, n = np.asarray(result.time), round(RECORD_S / DT_S)
    at = np.searchsorted(t_s, DT_S * np.arange(n) - 1e-9)  # events have rows of their own
    u, p_a, p_b, p_s, x, v, w = (
        np.asarray(result[k])[at] for k in ["u", "pa", "pb", "ps", "x", "v", "wp"]
    )
    if p_a.min() < 2e4 or p_b.min() < 2e4 or x.min() < 0.01 or x.max() > plant.constants.stroke_m:
        return None
    true = np.column_stack([u, p_a, p_b, p_s, np.full(n, plant.p_tank_pa), x, v])
    openings = np.column_stack([sign * w for sign in (1, -1, -1, 1, 0)])

    return Simulated(plant, noisy(true, seed), true, openings, partial(flow_of, plant))


def flow_of(plant: SimulatedPlant, edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
    """The true map, m3/s."""
    dp = np.asarray(dp_pa, float)
    shape = dp / np.sqrt(np.sqrt(dp * dp + LAMINAR_PA**2))
    return gain(plant, edge, np.asarray(w_v, float)) * shape
