"""A closed pump circuit with a double-rod cylinder as Modelica text: textbook hydraulics.

    V_1(x) / beta dp_1/dt =  D n - A v - L (p_1 - p_2) + what the charge line lets in
    V_2(x) / beta dp_2/dt = -D n + A v + L (p_1 - p_2) + what the charge line lets in

after Merritt, Hydraulic Control Systems (1967), pump-controlled motor.  The load is friction, which
puts that port under pressure that the pump delivers to.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

MODEL = """
model Drive
  Real p1(start = {charge}, fixed = true, nominal = 1e6);
  Real p2(start = {charge}, fixed = true, nominal = 1e6);
  Real x(start = {middle}, fixed = true);
  Real v(start = 0.0, fixed = true);
  Real n(start = 0.0, fixed = true);
  Real wish; Real load;
equation
  wish = {turns} * tanh(6.0 * sin({pace} * time)) * (0.65 + 0.35 * sin(0.37 * time));
  der(n) = (wish - n) / 0.12;
  load = {coulomb} * (1.0 + 0.4 * sin(0.21 * time)) * tanh(v / 0.002) + {viscous} * v;
  der(p1) * ({dead} + {area} * x) / {beta}
    = {turn} * n - {area} * v - {leak} * (p1 - p2) + {check} * max(0.0, {charge} - p1);
  der(p2) * ({dead} + {area} * ({stroke} - x)) / {beta}
    = -{turn} * n + {area} * v + {leak} * (p1 - p2) + {check} * max(0.0, {charge} - p2);
  der(x) = v;
  {mass} * der(v) = (p1 - p2) * {area} - load;
end Drive;
"""
HZ, RECORD_S, NOISE_PA, STEP_M = 500.0, 60.0, 4e4, 1e-5


@dataclass(frozen=True)
class DriveByText:
    """Displacement of a turn in m3, area in m2, leakage in m3/s/Pa, volume left at an end in m3."""

    turn: float
    area: float
    leak: float
    dead: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, leaks: bool) -> DriveByText:
        turn, area, leak, dead = rng.uniform([5e-6, 1.2e-3, 1e-12, 1e-4], [9e-6, 2e-3, 3e-12, 3e-4])
        return cls(float(turn), float(area), float(leak) * leaks, float(dead))

    @property
    def out(self) -> float:
        """The way of a turn, m."""
        return self.turn / self.area

    def recorded(self, path: Path, rng: np.random.Generator) -> Path:
        """A table of n in rpm, both pressures in bar and x in mm."""
        import rumoca

        text = MODEL.format(
            **vars(self), charge=5e5, middle=0.5, stroke=1.0, beta=8e8, mass=300.0, check=1e-8,
            turns=rng.uniform(10.0, 20.0), pace=rng.uniform(0.6, 1.0),
            coulomb=rng.uniform(2e3, 4e3), viscous=rng.uniform(1e4, 3e4),
        )  # fmt: skip
        result = rumoca.Session().loads(text, model="Drive").simulate(t=RECORD_S, dt=1.0 / HZ)
        t_s = np.arange(0.0, RECORD_S, 1.0 / HZ)
        at = np.searchsorted(np.asarray(result.time), t_s - 1e-9)
        n, p_1, p_2, x = (np.asarray(result[name])[at] for name in ("n", "p1", "p2", "x"))
        p_1, p_2 = (p + NOISE_PA * rng.standard_normal(len(p)) for p in (p_1, p_2))
        rows = [t_s, 60.0 * n, 1e-5 * p_1, 1e-5 * p_2, 1e3 * STEP_M * np.round(x / STEP_M)]
        head = "t_s,n_rpm,pA_bar,pB_bar,x_mm"
        np.savetxt(path, np.column_stack(rows), "%.7g", ",", header=head, comments="")
        return path
