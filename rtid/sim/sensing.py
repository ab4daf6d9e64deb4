"""What sensors make of the truth: lag, bias, scale, noise, quantisation.

A lagging pressure sensor is two equal first-order lags of half the stated time one behind the
other: a membrane behind a capillary.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.plain import FloatArray
from rtid.sim.compiled import compiled
from rtid.sim.extra_physics import Extra

NAMES = ("u", "p_a", "p_b", "p_supply", "p_tank", "x", "v")
U, P_A, P_B, P_S, P_T, X, V = range(7)  # columns of NAMES
COUNTS = 65535  # 16 bit


@dataclass(frozen=True)
class Sensors:
    """White noise (1 sigma) and range of each sensor, SI; 16 bit over the range."""

    p_noise_pa: float = 5e3
    p_tank_noise_pa: float = 1e3
    x_noise_m: float = 1e-5
    v_noise_mps: float = 1e-3
    p_range_pa: float = 10e6
    x_range_m: float = 0.5
    v_range_mps: float = 1.0  # -0.5..0.5
    u_range_v: float = 20.0  # -10..10
    quantised: bool = True

    def noise(self) -> FloatArray:
        """1 sigma per column of NAMES, float64 (7,), SI."""
        p = self.p_noise_pa
        return np.array([0, p, p, p, self.p_tank_noise_pa, self.x_noise_m, self.v_noise_mps])

    def resolution(self) -> FloatArray:
        """Quantisation step per column of NAMES, float64 (7,), SI; 0: not quantised."""
        p = self.p_range_pa
        ranges = np.array([self.u_range_v, p, p, p, p, self.x_range_m, self.v_range_mps])
        return ranges / COUNTS if self.quantised else np.zeros(7)

    def quantise(self, values: FloatArray) -> FloatArray:
        """The values (n, 7), SI, as the sensors' counts give them back."""
        steps = self.resolution()
        return np.floor(values / steps + 0.5) * steps if self.quantised else values


EXACT = Sensors(p_noise_pa=0, p_tank_noise_pa=0, x_noise_m=0, v_noise_mps=0, quantised=False)


@compiled
def lag(values: FloatArray, tau_s: float, dt_s: float) -> None:
    """Send values (n,), taken as linear between samples, through a first-order lag in place."""
    keep = np.exp(-dt_s / tau_s)
    before, y = values[0], values[0]
    for i in range(1, len(values)):
        behind = (values[i] - before) / dt_s * tau_s
        y = values[i] - behind + (y - before + behind) * keep
        before, values[i] = values[i], y


def see(
    e: Extra,
    signals: FloatArray,
    ports_pa: FloatArray,
    p_set_pa: FloatArray,
    noise: FloatArray,
    dt_s: float,
) -> FloatArray:
    """What the sensors say of the true signals, before counting, float64 (n, 7).

    ports_pa (n, 2): chamber pressures at the valves; p_set_pa (n,): what stands in place of the
    supply pressure if no sensor sees the pump's droop; noise (n, 7).
    """
    values = signals.copy()
    if e.sensor_at_valve:
        values[:, [P_A, P_B]] = ports_pa
    for chamber, column in enumerate((P_A, P_B)):
        tau_s = 0.5 * e.pressure_lag_s[chamber]
        for _ in range(2 if tau_s > 0 else 0):
            lag(values[:, column], tau_s, dt_s)
        values[:, column] += e.pressure_bias_pa[chamber]
    values[:, V] *= 1.0 + e.velocity_scale
    values += noise
    if e.sag_pasm3 and not e.sag_measured:
        values[:, P_S] = p_set_pa
    return values
