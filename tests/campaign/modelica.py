"""Machines between valves as Modelica text, compiled and integrated by rumoca: textbook hydraulics.

    orifice       Q = K(w) dp / (dp^2 + dp_lam^2)^(1/4), K a hyperbola above the overlap
    compensated   a pressure compensator keeps the drop at the metering edge at p_set where there is
                  more: dp_m = dp p_set / (dp^4 + p_set^4)^(1/4); what returns passes plain edges
    spool         four edges ground on one spool, that of the sensor's zero off
    motor         D dtheta/dt = +-Q - V / beta dp/dt - leaks, V constant; it goes round for ever

after Merritt, Hydraulic Control Systems (1967), and Watton, Fundamentals of Fluid Power Control
(2009).  A motor's angle counts LEVER rad for a metre of the cylinder that it is drawn from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from firmware_bridge.samples import GAP, ROW, Samples
from rtid.model import Chamber, Machine
from rtid.plain import FloatArray
from rtid.sim.declare import ENDS, declared_model, default_grid
from rtid.sim.demand import DT_S
from rtid.sim.random_plants import draw
from rtid.sim.run import NAMES, Run, Sensors, Truth
from rtid.sim.sensing import X
from rtid.sim.simulated_plant import AB, EDGES, SimulatedPlant
from tests.campaign.kinds import SPOOL, kind_of

COMPENSATED, MOTOR = "compensated", "motor"
TEXTBOOK = COMPENSATED, SPOOL, MOTOR
RECORD_S, LEARN_S, HALF_SAMPLE_S = 44.0, 32.0, 0.5e-3
LEVER, TURNS_MPS = 200.0, 0.02  # rad/m; a motor's mean speed, in that of the cylinder
LAMINAR_PA, P_SET_PA, WIDER = 3e4, 1.0e6, 1.5
SAFE_V = 1.0  # below it the valves pass nothing, as their user declares
LEAK, LAG, VOLUME = "internal_leakage_laminar", "spool_lag_first_order", "extra_dead_volume"
SIZES = {LEAK: 4e-12, LAG: 5e-3, VOLUME: 4e-4}  # m3/s/Pa, s, m3

MODEL = """
model Machine
  Real pa(start = {pa0}, fixed = true, nominal = 1e6);
  Real pb(start = {pb0}, fixed = true, nominal = 1e6);
  Real x(start = {x0}, fixed = true);
  Real v(start = 0.0, fixed = true);
  Real wp(start = 0.0, fixed = true);{more}
  Real ps; Real xr; Real vr; Real demand; Real u; Real load;
  Real qpa; Real qat; Real qpb; Real qbt; Real learning;
equation
  learning = if time < {learn_s} then 1.0 else 0.0;
  xr = {x0} + {drift} * time + (if time < {learn_s}
    then {amplitude} * sin(0.628 * time + {slope} * time * time)
    else {amplitude} * (0.7 * sin(1.1 * (time - {learn_s})) + 0.5 * sin(2.3 * time + 0.4)));
  vr = {drift} + (if time < {learn_s}
    then {amplitude} * (0.628 + 2 * {slope} * time) * cos(0.628 * time + {slope} * time * time)
    else {amplitude} * (0.77 * cos(1.1 * (time - {learn_s})) + 1.15 * cos(2.3 * time + 0.4)));
  ps = {ps} * (1.0 + 0.12 * sin(0.29 * time) + 0.06 * sin(0.81 * time + 1.0));
  load = {force} * (1.0 + 0.15 * sin(1.9 * time) + 0.15 * sin(6.1 * time + 2.0));
  demand = (vr + 5.0 * (xr - x)) / {lever};
  u = {band} * tanh(demand / 0.004) + {gain} * demand
    + learning * (0.3 * sin(11.0 * time) + 0.25 * sin(29.0 * time + 1.0)
    + 0.2 * sin(53.0 * time + 2.0));
  der(wp) = ({sent} - wp) / {lag};{pilot}
{edges}
  der(pa) * ({va}) / {beta} = qpa - qat - {da} * v - {leak} * (pa - pb);
  der(pb) * ({vb}) / {beta} = qpb - qbt + {db} * v + {leak} * (pa - pb);
  der(x) = v;
  {inertia} * der(v) = pa * {da} - pb * {db} - load - {coulomb} * tanh(v / {creep})
    - {viscous} * v;
end Machine;
"""
PILOT = """
  der(wu) = (u - wu) / {late};"""  # a pilot stage in front of the spool
OPENING = "max(0.0, {way} * wp - {band})"
EDGE = """  q{edge} = {k} * ({opening}^2 / (0.1 + {opening})) * ({dp})
    / sqrt(sqrt(({dp}) * ({dp}) + {laminar}));"""
DROPS = {"pa": "ps - pa", "at": "pa - {pt}", "pb": "ps - pb", "bt": "pb - {pt}"}
METERED = "({dp}) * {p_set} / sqrt(sqrt(({dp})^4 + {p_set}^4))"


@dataclass(frozen=True)
class Textbook:
    """A machine of a kind with this number; hidden: one of SIZES, or nothing.

    A leak from a to b, a pilot stage's lag before the spool's own, a volume behind both ports.
    """

    kind: str
    seed: int
    hidden: str = ""

    @property
    def law(self) -> str:
        """Of its valves, as its kind."""
        return self.kind

    @property
    def motion(self) -> str:
        """The one motion that there is."""
        return "rich"

    @cached_property
    def drawn(self) -> SimulatedPlant:
        """The sizes: of a motor those of a cylinder of LEVER rad per metre, equal on both sides."""
        plant = kind_of(self.seed, SPOOL) if self.kind == SPOOL else draw(self.seed)
        if self.kind != MOTOR:
            return plant
        c = plant.constants
        equal = c._replace(area_b_m2=c.area_a_m2, v0_b_m3=c.v0_a_m3)
        return replace(plant, constants=equal)

    @property
    def beta_pa(self) -> float:
        """The bulk modulus."""
        return self.drawn.beta_pa

    @property
    def p_set_pa(self) -> float:
        """What a compensator keeps at its metering edge; infinite without one."""
        number = np.random.default_rng([self.seed, 21]).uniform(0.6, 1.4)
        return P_SET_PA * float(number) if self.kind == COMPENSATED else float("inf")

    def gain(self, edge: str) -> float:
        """K per volt, m3/s/sqrt(Pa)/V: wider where a compensator takes most of the drop."""
        valve = self.drawn.valves[EDGES.index(edge)]
        return valve.gain * (WIDER if self.kind == COMPENSATED and edge.startswith("p") else 1.0)

    def flow(self, edge: str, w_v: FloatArray, dp_pa: FloatArray) -> FloatArray:
        """The true map, m3/s, of w (...) in V and dp (...) in Pa."""
        valve, dp = self.drawn.valves[EDGES.index(edge)], np.asarray(dp_pa, float)
        above = np.maximum(0.0, np.asarray(w_v, float) - valve.deadband_v)
        if edge.startswith("p") and np.isfinite(self.p_set_pa):
            dp = dp * self.p_set_pa / (dp**4 + self.p_set_pa**4) ** 0.25
        shape = dp / np.sqrt(np.sqrt(dp * dp + LAMINAR_PA**2))
        return np.asarray(self.gain(edge) * above**2 / (0.1 + above) * shape)

    def hidden_size(self, effect: str) -> float:
        """Of an effect, SI, where it is hidden in this machine; else 0."""
        return SIZES[effect] if self.hidden == effect else 0.0

    @property
    def text(self) -> str:
        """The model."""
        plant, c = self.drawn, self.drawn.constants
        lever = LEVER if self.kind == MOTOR else 1.0
        p_b, middle = 0.3 * plant.p_supply_pa, 0.5 * c.stroke_m
        dead_a, dead_b = (v + self.hidden_size(VOLUME) for v in (c.v0_a_m3, c.v0_b_m3))
        volumes = (
            f"{dead_a} + {c.area_a_m2} * x",
            (f"{dead_b} + {c.area_b_m2} * ({c.stroke_m} - x)"),
        )
        if self.kind == MOTOR:
            volumes = f"{dead_a}", f"{dead_b}"
        late = self.hidden_size(LAG)
        return MODEL.format(
            edges="\n".join(self._edges()), va=volumes[0], vb=volumes[1],
            pa0=(c.gravity_n + p_b * c.area_b_m2) / c.area_a_m2, pb0=p_b, x0=lever * middle,
            drift=lever * TURNS_MPS if self.kind == MOTOR else 0.0, learn_s=LEARN_S,
            amplitude=0.065 * lever, slope=0.5 * (3.14 - 0.628) / LEARN_S, ps=plant.p_supply_pa,
            force=c.gravity_n / lever, lever=lever, band=plant.controller.deadband_v,
            gain=plant.controller.volts_per_mps, lag=plant.lag_s + HALF_SAMPLE_S, beta=c.beta_pa,
            da=c.area_a_m2 / lever, db=c.area_b_m2 / lever, leak=self.hidden_size(LEAK),
            sent="wu" if late else "u", pilot=PILOT.format(late=late) if late else "",
            more="\n  Real wu(start = 0.0, fixed = true);" if late else "",
            inertia=c.mass_kg / lever**2, coulomb=c.coulomb_n / lever, creep=0.004 * lever,
            viscous=c.viscous_nspm / lever**2,
        )  # fmt: skip

    def _edges(self) -> list[str]:
        lines = []
        for edge, way, valve in zip(EDGES, (1, -1, -1, 1), self.drawn.valves, strict=False):
            dp = DROPS[edge].format(pt=self.drawn.p_tank_pa)
            if edge.startswith("p") and np.isfinite(self.p_set_pa):
                dp = METERED.format(dp=dp, p_set=self.p_set_pa)
            opening = OPENING.format(way=f"{way}.0", band=valve.deadband_v)
            lines.append(
                EDGE.format(
                    edge=edge, k=self.gain(edge), opening=opening, dp=dp, laminar=LAMINAR_PA**2
                )
            )
        return lines

    @property
    def sensors(self) -> Sensors:
        """As usual; of an angle 2 mrad, and no steps."""
        if self.kind != MOTOR:
            return Sensors()
        return Sensors(x_noise_m=1e-5 * LEVER, v_noise_mps=1e-3 * LEVER, x_range_m=1e6,
                       v_range_mps=1e6, quantised=False)  # fmt: skip

    @property
    def machine(self) -> Machine:
        """As its user declares it."""
        plant, sensors = self.drawn, self.sensors
        grid = default_grid(1.25 * plant.p_supply_pa)
        model = declared_model(plant, grid=grid, sensors=sensors, seed=self.seed)
        if self.kind != MOTOR:
            return model
        c = plant.constants
        sides = ("a", "p_a", 1, c.v0_a_m3), ("b", "p_b", -1, c.v0_b_m3)
        motor = tuple(
            Chamber(name, pressure, c.area_a_m2 / LEVER, sign, v0_m3, is_constant=True)
            for name, pressure, sign, v0_m3 in sides
        )
        units = {"x": "rad", "v": "rad/s"}
        signals = tuple(replace(s, unit=units.get(s.name, s.unit)) for s in model.signals)
        return replace(model, chambers=motor, signals=signals)

    def run(self) -> Run | None:
        """One record with its truth; None where the machine cavitates or leaves its stroke."""
        import rumoca

        model = rumoca.Session().loads(self.text, model="Machine")
        try:
            result = model.simulate(t=RECORD_S, dt=DT_S)
        except rumoca.SimulationError:
            return None
        n = round(RECORD_S / DT_S)
        at = np.searchsorted(np.asarray(result.time), DT_S * np.arange(n) - 1e-9)
        names = "u", "pa", "pb", "ps", "x", "v", "wp"
        u, p_a, p_b, p_s, x, v, w = (np.asarray(result[k])[at] for k in names)
        true = np.column_stack([u, p_a, p_b, p_s, np.full(n, self.drawn.p_tank_pa), x, v])
        stroke = np.inf if self.kind == MOTOR else self.drawn.constants.stroke_m
        if min(p_a.min(), p_b.min()) < 2e4 or not 0.01 < x.min() <= x.max() < stroke:
            return None
        opening = np.column_stack([way * w for way in (1, -1, -1, 1, 0)])
        return Run(self.drawn, self.sensors, self._seen(true), self._truth(true, opening))

    def _seen(self, true: FloatArray) -> Samples:
        rng = np.random.default_rng([self.seed, 3])
        values = true + self.sensors.noise() * rng.standard_normal(true.shape)
        flags = np.full(len(true), ROW, np.uint8)
        flags[0] |= GAP
        t_us = np.arange(len(true), dtype=np.int64) * round(1e6 * DT_S)
        return Samples(NAMES, t_us, self.sensors.quantise(values), flags)

    def _truth(self, true: FloatArray, opening: FloatArray) -> Truth:
        flows = np.zeros((len(true), len(EDGES)))
        for k, edge in enumerate(EDGES[:AB]):
            high, low = (true[:, NAMES.index(end)] for end in ENDS[edge])
            flows[:, k] = self.flow(edge, opening[:, k], high - low)
        ports, extra = true[:, 1:3], np.zeros((len(true), 2))
        return Truth(true, opening, flows, true[:, X], ports, extra)
