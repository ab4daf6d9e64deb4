"""Friction on what is measured that builds up over a way, after Dahl.

dz/dt = v / x_h (1 - z sgn v),    exactly over a step with the mean velocity v:
z+ = s + (z - s) exp(-|v| dt / x_h),   s = sgn v
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from rtid.effects.column import Cause, of_page
from rtid.effects.law import Shape, Volumes
from rtid.effects.motions import halves_of
from rtid.effects.page import Effect
from rtid.effects.record_view import RecordView
from rtid.kernels.jit import kernel
from rtid.model import VELOCITY
from rtid.plain import FloatArray

SHARES = (0.05, 0.15, 0.3, 0.5)  # of the way between reversals, to begin with
SLOW = 0.05  # of the largest velocity
LEAST_M = 1e-9


def dahl(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """The friction over each measured velocity, beside a rate that is measured itself."""
    halves = halves_of(view.model)
    for signal in view.model.signals if view.model.measured else ():
        if signal.kind == VELOCITY and signal.name not in halves:
            v = view.signal(signal.name)

            def column(shape: Shape, v: FloatArray = v) -> Volumes:
                z = built_up(v, view.dt_s, shape[0])
                return {0: 0.5 * (z[1:] + z[:-1]) * view.dt_s}

            page = of_page(effect, signal.name, shape=("way",))
            stroke = stroke_of(v, view.dt_s)
            if stroke > 0.0:
                yield Cause(page, column, (tuple(share * stroke for share in SHARES),))


def stroke_of(v: FloatArray, dt_s: FloatArray) -> float:
    """Mean way between two reversals of velocities (n,), m/s, m; about zero noise reverses too."""
    turned = np.sign(v[np.abs(v) > SLOW * np.abs(v).max()])
    way = float(np.abs(0.5 * (v[1:] + v[:-1]) * dt_s).sum())
    return way / max(1, int(np.count_nonzero(np.diff(turned))))


def built_up(v: FloatArray, dt_s: FloatArray, way_m: float) -> FloatArray:
    """How far the friction has built up (n,), -1 to 1, of velocities (n,), m/s; it begins at 0."""
    z = np.empty(len(v))
    _build_up(0.5 * (v[1:] + v[:-1]) * dt_s / max(way_m, LEAST_M), z)
    return z


@kernel
def _build_up(way: FloatArray, z: FloatArray) -> None:
    """way (n - 1,): of each step, in units of x_h; z (n,) is filled."""
    z[0] = 0.0
    for k in range(len(way)):
        s = 1.0 if way[k] > 0.0 else -1.0
        z[k + 1] = s + (z[k] - s) * math.exp(-abs(way[k]))
