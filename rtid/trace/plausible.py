"""Does the machine move as declared?  Signs, swapped chambers, stiffness, velocity.

Two tests need no fit of the maps.  Open edges move the piston the way they say: over windows,
corr(push, dx) > 0 with push = sum(direction sigma s_c w).  And each chamber is a spring: at equal
command

    s_c A_c dx = - V_c dP_c theta_c + (what depends on u and P alone),   theta_c = 1 / beta_c > 0.

A reversed command turns the first sign alone, a reversed position both, swapped chamber pressures
the second alone; a wrong unit makes 1 / theta_c no bulk modulus.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.samples import GAP, ROW, Samples
from rtid.model import Chamber, Machine
from rtid.plain import BoolArray, FloatArray
from rtid.units import Unit, units_of

WINDOW_S = 0.02
MIN_WINDOWS = 100
COMMAND_BINS = 40


@dataclass(frozen=True)
class Spring:
    """Rough bulk modulus of one chamber, Pa, and its t value; NaN where too little moved."""

    beta_pa: float
    t: float


@dataclass(frozen=True)
class Motion:
    """How the machine moves, each NaN where nothing can be told.

    u_to_v: correlation of push and motion, positive as declared; v_slope: measured velocity over
    the derivative of the position, 1 where both agree.
    """

    u_to_v: float
    springs: dict[str, Spring]
    v_slope: float


@dataclass(frozen=True)
class Windows:
    """Of windows without a gap: means of all signals, first values and changes (n, m)."""

    mean: FloatArray
    start: FloatArray
    change: FloatArray


def motion(model: Machine, samples: Samples) -> Motion:
    """Judge signs and stiffness from the samples of a trace."""
    windows = _windows(model, samples)
    if len(windows.mean) < MIN_WINDOWS:
        nothing = Spring(float("nan"), float("nan"))
        return Motion(float("nan"), {c.name: nothing for c in model.chambers}, float("nan"))
    springs = {c.name: _spring(model, c, windows) for c in model.chambers if c.pressure}
    return Motion(_u_to_v(model, windows), springs, _v_slope(model, samples))


def _windows(model: Machine, samples: Samples) -> Windows:
    """Windows of 20 ms, but of two rows at least; each border lies on a row."""
    rows = np.flatnonzero(samples.flags & ROW)
    if len(rows) < 3:
        return Windows(*(np.empty((0, len(samples.names))) for _ in range(3)))
    period_s = float(np.median(np.diff(samples.t_us[rows]))) * 1e-6
    border = rows[:: max(2, round(WINDOW_S / period_s))]
    total = np.concatenate([np.zeros((1, len(samples.names))), np.cumsum(samples.values, axis=0)])
    mean = np.diff(total[border], axis=0) / np.diff(border)[:, None]
    whole, values = _unbroken(model, samples, border), samples.values[border]
    return Windows(mean[whole], values[:-1][whole], np.diff(values, axis=0)[whole])


def _unbroken(model: Machine, samples: Samples, border: NDArray[np.intp]) -> BoolArray:
    """Whether the samples between two borders follow one another without a gap, bool (n - 1,)."""
    step_s = np.diff(samples.t_us) * 1e-6
    joined = (step_s > 0) & (step_s <= model.gates.max_gap_s) & ((samples.flags[1:] & GAP) == 0)
    gaps = np.concatenate([[0], np.cumsum(~joined)])
    return np.asarray(np.diff(gaps[border]) == 0)


def _u_to_v(model: Machine, windows: Windows) -> float:
    signs = {c.pressure: c.sign for c in model.chambers}
    push = np.zeros(len(windows.mean))
    for edge in model.edges:
        extends = signs.get(edge.sink, 0) - signs.get(edge.source, 0)
        w = edge.direction * windows.mean[:, model.column(edge.command)]
        push += extends * np.maximum(w, 0.0)
    moved = windows.change[:, model.column(model.position)]
    size = float(np.sqrt(np.dot(push, push) * np.dot(moved, moved)))
    return float(np.dot(push, moved)) / size if size > 0 else float("nan")


def _spring(model: Machine, chamber: Chamber, windows: Windows) -> Spring:
    """Regress the swept volume on V dP and P, each about its mean at equal command."""
    x, p = model.column(model.position), model.column(chamber.pressure)
    volume = chamber.volume(windows.start[:, x])
    swept = chamber.sign * chamber.area_m2 * windows.change[:, x]
    columns = (-volume * windows.change[:, p], windows.mean[:, p], swept)
    stored, level, y = (_about_bin_mean(c, _command_bin(model, windows)) for c in columns)
    phi = np.stack([stored, level], axis=1)
    scale = np.linalg.norm(phi, axis=0)
    if not (scale > 0).all():
        return Spring(float("nan"), float("nan"))
    theta, *_ = np.linalg.lstsq(phi / scale, y, rcond=None)
    gram = (phi / scale).T @ (phi / scale)
    residual = y - phi / scale @ theta
    sd = float(np.sqrt(np.dot(residual, residual) / len(y) * np.linalg.pinv(gram)[0, 0]))
    known = theta[0] != 0 and sd > 0
    nan = float("nan")
    return Spring(float(scale[0] / theta[0]), float(theta[0]) / sd) if known else Spring(nan, nan)


def _command_bin(model: Machine, windows: Windows) -> NDArray[np.intp]:
    """Number of the bin of the command, bins of equal count."""
    command = next(s.name for s in model.signals if s.kind == "command")
    u = windows.mean[:, model.column(command)]
    inner = np.quantile(u, np.linspace(0, 1, COMMAND_BINS + 1)[1:-1])
    return np.digitize(u, inner)


def _about_bin_mean(c: FloatArray, k: NDArray[np.intp]) -> FloatArray:
    count = np.maximum(np.bincount(k, minlength=COMMAND_BINS), 1)
    return c - (np.bincount(k, c, COMMAND_BINS) / count)[k]


def _v_slope(model: Machine, samples: Samples) -> float:
    """Least-squares slope of integrated velocity over position, NaN without a velocity signal."""
    names = [s.name for s in model.signals if s.kind == "velocity"]
    rows = np.flatnonzero(samples.flags & ROW)[::10]
    if not names:
        return float("nan")
    v, dt_s = samples.column(names[0]), np.diff(samples.t_us) * 1e-6
    travelled = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * dt_s)])
    whole = _unbroken(model, samples, rows)
    x = samples.column(model.position)[rows]
    dx, dv = np.diff(x)[whole], np.diff(travelled[rows])[whole]
    size = float(np.dot(dx, dx))
    return float(np.dot(dx, dv)) / size if size > 0 else float("nan")


def looks_like(value: float, low: float, high: float, declared: Unit) -> Unit | None:
    """The unit in which a value, read in `declared`, would lie between low and high (all SI).

    None if it lies there already or no unit does; of several the one that comes nearest to `high`
    on a logarithmic scale.
    """
    if not value > 0 or low <= value <= high:
        return None
    meant = {u: value * u.factor / declared.factor for u in units_of(declared.dimension)}
    fitting = [unit for unit, size in meant.items() if low <= size <= high]
    return max(fitting, key=lambda unit: meant[unit], default=None)
