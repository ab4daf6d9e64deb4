"""The paper's motion, within the same limits: a sine of 0.1 to 0.5 Hz."""

from __future__ import annotations

import numpy as np

from rtid.excite.driving import STEP_S, SUPPLY, V_REF, X_REF
from rtid.excite.library import home_m
from rtid.excite.machine import DrivenMachine
from rtid.excite.motion_limits import Limits
from rtid.plain import FloatArray

BAND_HZ = (0.1, 0.5)
SHARE = 0.95  # of the largest command, at the highest speed


def swept_sine(machine: DrivenMachine, limits: Limits) -> FloatArray:
    """Its reference (n, 5), SI, at the usual supply, as far as command, speed and stroke allow."""
    control, (low, high) = machine.control, BAND_HZ
    speed = (SHARE * limits.command_v - control.deadband_v) / control.volts_per_mps
    half = 0.5 * (limits.stroke_m[1] - limits.stroke_m[0])
    amplitude = min(half, min(speed, limits.speed_mps) / (2 * np.pi * high))
    t = STEP_S * np.arange(round(limits.duration_s / STEP_S))
    slope = (high - low) / limits.duration_s
    phase = 2 * np.pi * (low * t + 0.5 * slope * t**2)
    reference = np.zeros((len(t), 5))
    reference[:, X_REF] = home_m(limits) + amplitude * np.sin(phase)
    reference[:, V_REF] = amplitude * 2 * np.pi * (low + slope * t) * np.cos(phase)
    reference[:, SUPPLY] = np.clip(machine.supply_pa, *limits.supply_pa)
    return reference
