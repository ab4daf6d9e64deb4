"""The plant of Fig. 3: one state, and an input nonlinearity that is not smooth.

    dx/dt = f(u, x) + theta d,   f = r (0.35 + 0.12 x - 0.012 x^2) (1 + 0.04 r),
                                 r = max(0, u - 1.3 - 0.1 x)

f has a dead band that ends between u = 1 and 2, elsewhere for every x, with a sharp corner.  theta
is unknown.  The input d keeps x on a reference that wanders over the whole range, u wanders by
itself; u, x and d are sent as the frames of `firmware_bridge/controller.dbc`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from firmware_bridge.catalog import load
from firmware_bridge.config import CYCLE, Assembly, SignalSource
from rtid.estimator.chunk import to_chunk
from rtid.model import (
    COMMAND,
    NONE,
    POSITION,
    TAYLOR,
    Chamber,
    Edge,
    Gates,
    Grid,
    Machine,
    Signal,
    Term,
)
from rtid.plain import FloatArray
from rtid.sim.frames import Route, cycle_frames, messages_of
from rtid.trace.reading import assemble

ROUTES = {
    "u": Route("ValveCommand", "U", held=True),
    "x": Route("Motion", "X"),
    "d": Route("Motion", "V"),
}
U_MAX, X_MAX, D_MAX = 5.0, 4.0, 3.9
U_STEP, X_STEP = 10.0 / 65535, 0.5 / 65535  # of the frames
NOISE = 1e-3  # of x and d, 1 sigma
THETA = 1.5
DT_S = 1e-3
WAVES = 6  # sines of which a wandering input is made
TRACKING_1PS = 20.0


@njit(cache=True)
def _value(u: float, x: float) -> float:
    r = max(0.0, u - 1.3 - 0.1 * x)
    return r * (0.35 + 0.12 * x - 0.012 * x * x) * (1.0 + 0.04 * r)


def true_value(u: ArrayLike, x: ArrayLike) -> FloatArray:
    """f(u, x) at broadcast points, 1/s."""
    us, xs = np.broadcast_arrays(np.asarray(u, float), np.asarray(x, float))
    return np.vectorize(_value)(us, xs)


@njit(cache=True)
def _simulate(u: FloatArray, reference: FloatArray, dt_s: float) -> FloatArray:
    """x and d (2, n): Runge-Kutta steps, u held, d linear between samples and one sample late."""
    out = np.empty((2, len(u)))
    x, d = reference[0], 0.0
    for k in range(len(u)):
        out[0, k], out[1, k] = x, d
        wanted = (TRACKING_1PS * (reference[k] - x) - _value(u[k], x)) / THETA
        late = min(max(wanted, -D_MAX), D_MAX)
        middle = THETA * 0.5 * (d + late)
        a = _value(u[k], x) + THETA * d
        b = _value(u[k], x + 0.5 * dt_s * a) + middle
        c = _value(u[k], x + 0.5 * dt_s * b) + middle
        e = _value(u[k], x + dt_s * c) + THETA * late
        x, d = x + dt_s / 6.0 * (a + 2.0 * b + 2.0 * c + e), late
    return out


def record(seed: int = 0, duration_s: float = 120.0) -> FloatArray:
    """Simulate, send as CAN frames, assemble: rows of `to_chunk` for `declared` (n, 5)."""
    rng, n = np.random.default_rng([seed, 3]), round(duration_s / DT_S)
    u = U_STEP * np.rint(_wander(rng, n, 0.0, U_MAX, (0.05, 0.5)) / U_STEP)
    x, d = _simulate(u, _wander(rng, n, 0.05, X_MAX - 0.05, (0.05, 0.3)), DT_S)
    noisy = {"x": x, "d": d}
    columns = {"u": u} | {k: v + NOISE * rng.standard_normal(n) for k, v in noisy.items()}
    catalog = load()
    frames = cycle_frames(catalog, ROUTES, columns, 1000 * np.arange(n, dtype=np.int64))
    sources = tuple(
        SignalSource(name, route.message, route.signal, command=route.held, hold=_hold(route))
        for name, route in ROUTES.items()
    )
    messages = tuple(catalog.message_source(name) for name in messages_of(ROUTES))
    samples, _ = assemble(catalog, Assembly(CYCLE, sources, messages, "x"), frames)
    return to_chunk(declared(grid()), samples, int(samples.t_us[0]))


def _hold(route: Route) -> str:
    return "zero" if route.held else "linear"


def _wander(
    rng: np.random.Generator, n: int, low: float, high: float, band_hz: tuple[float, float]
) -> FloatArray:
    """Sines of random frequency and phase, stretched to spend as long at every value (n,)."""
    t = DT_S * np.arange(n)
    waves = zip(rng.uniform(*band_hz, WAVES), rng.uniform(0, 2 * np.pi, WAVES), strict=True)
    total = np.sum([np.sin(2 * np.pi * f * t + phase) for f, phase in waves], axis=0)
    return low + (high - low) * np.argsort(np.argsort(total)) / n


def grid(fine: float = 0.125, coarse: float = 1.0, x_step: float = 1.0) -> Grid:
    """Borders along u: `fine` between 1 and 2, where the dead band may end, `coarse` elsewhere."""
    near = np.linspace(1.0, 2.0, round(1.0 / fine) + 1)
    below = np.linspace(0.0, 1.0, round(1.0 / coarse) + 1)[:-1]
    above = np.linspace(2.0, U_MAX, round((U_MAX - 2.0) / coarse) + 1)[1:]
    return Grid(
        np.concatenate([below, near, above]), np.linspace(0, X_MAX, round(X_MAX / x_step) + 1)
    )


def declared(blocks: Grid, basis: str = TAYLOR) -> Machine:
    """What is known of this plant: signals, noise, grid, and that theta d drives it too."""
    state = "state"
    edge = Edge("f", "x", NONE, "u", 1, blocks, -np.inf, 2.0, X_MAX, basis, signs=((state, 1),))
    return Machine(
        signals=(
            Signal("u", COMMAND),
            Signal("x", POSITION, "", NOISE, X_STEP),
            Signal("d", POSITION, "", NOISE, X_STEP),
        ),
        chambers=(Chamber(state, NONE, 1.0, 1, 0.0),),
        edges=(edge,),
        position="x",
        beta_nominal_pa=1.0,
        beta_bounds_pa=(0.5, 2.0),
        gates=Gates(max_sd_share=0.01),
        terms=(Term("theta", (("d", 1.0),), ((state, 1),), 1.0),),
    )
