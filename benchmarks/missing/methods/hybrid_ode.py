"""A universal differential equation: the known balance of a chamber, its valves by neural nets.

    V dP/dt = beta (sum of sigma_e s_e N_e(w, s) - s A v),   s the signed root of the pressure drop

N_e has two hidden layers of 16.  First the derivative is matched (collocation), then free runs of
0.1 s from the filtered pressure (Heun, 1 ms), as the literature on universal differential equations
recommends.  jax and optax (Apache-2.0), Adam, double precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.typing import ArrayLike

from benchmarks.missing.chamber import FAST_S, FLOW, USUAL_PA, ChamberData, chambers
from benchmarks.missing.front import Front, Working, smooth
from benchmarks.missing.methods.data_sheet import predicted
from benchmarks.missing.record import Learned, Record
from rtid.plain import FloatArray

jax.config.update("jax_enable_x64", True)
HIDDEN = (16, 16)
MATCHING, RUNNING = 40000, 500  # steps of Adam: after 4000 of matching six times the error is left
ROWS = 2048  # of a step of matching, drawn anew for each
RATES = 5e-3, 1e-3
BATCH, WINDOW, EVERY = 96, 100, 10
SAFE_V, MPA = 1.0, 1e6
UNIT = float(np.sqrt(USUAL_PA))


def net(key: Any) -> list[Any]:
    """Weights of a net of two inputs and one output."""
    sizes, layers = (2, *HIDDEN, 1), []
    for n, m in pairwise(sizes):
        key, one = jax.random.split(key)
        layers.append((jax.random.normal(one, (n, m)) / jnp.sqrt(n), jnp.zeros(m)))
    return layers


def through(layers: list[Any], w: Any, s: Any) -> Any:
    """Flow in units of FLOW at commands w in V and roots s in UNIT."""
    h = jnp.stack([(w - 4.0) / 2.0, s - 1.0], axis=-1)
    for weight, shift in layers[:-1]:
        h = jnp.tanh(h @ weight + shift)
    weight, shift = layers[-1]
    gain = (h @ weight + shift)[..., 0]
    return jnp.where(w > SAFE_V, s * gain, 0.0)


def slope(theta: Any, sign: Any, p: Any, row: Any) -> Any:
    """dP/dt in MPa/s; p in MPa, row (..., 6) of `chamber.slope`."""
    flow = -row[..., 4] / FLOW
    for e in range(2):
        dp = sign[e] * (row[..., 2 + e] / MPA - p) * MPA / USUAL_PA
        s = jnp.sign(dp) * jnp.sqrt(jnp.abs(dp) + 1e-9)
        flow = flow + sign[e] * through(theta[1 + e], row[..., e], s)
    return jnp.exp(theta[0]) * 1e3 * FLOW * flow / row[..., 5]


def matching(theta: Any, sign: Any, p: Any, rows: Any, rate: Any, weight: Any) -> Any:
    """Mean square of the derivative's miss, in units of the flow."""
    miss = (slope(theta, sign, p, rows) - rate) * rows[:, 5] * jnp.exp(-theta[0]) * 1e-3 / FLOW
    return jnp.mean(weight * miss**2)


def running(theta: Any, sign: Any, start: Any, rows: Any, measured: Any) -> Any:
    """Mean of the free runs' miss in 5 kPa, softly bounded: rows (windows, WINDOW + 1, 6)."""
    rows = jnp.swapaxes(rows, 0, 1)

    def step(p: Any, ends: Any) -> Any:
        before, after = ends
        a = slope(theta, sign, p, before)
        b = slope(theta, sign, p + 1e-3 * a, after)
        p = jnp.clip(p + 0.5e-3 * (a + b), -1.0, 40.0)
        return p, p

    _, path = jax.lax.scan(step, start, (rows[:-1], rows[1:]))
    miss = (path[EVERY - 1 :: EVERY].T - measured) / 5e-3
    return jnp.mean(2.0 * (jnp.sqrt(1.0 + 0.25 * miss**2) - 1.0))


@partial(jax.jit, static_argnums=(0, 1))
def one_step(loss: Any, rate: float, theta: Any, state: Any, share: Any, *data: Any) -> Any:
    """A step of Adam, its rate falling to a tenth with share from 0 to 1."""
    slopes = jax.grad(loss)(theta, *data)
    update, state = optax.adam(1.0).update(slopes, state)
    update = jax.tree.map(lambda u: rate * 0.1**share * u, update)
    return optax.apply_updates(theta, update), state


@dataclass(frozen=True)
class Hybrid:
    """The trained unknowns of a chamber."""

    theta: Any

    @property
    def beta_pa(self) -> float:
        """The modulus."""
        return float(np.exp(self.theta[0])) * 1e9

    def flow(self, k: int, w: FloatArray, dp_pa: FloatArray) -> FloatArray:
        """Q of its k-th valve, m3/s."""
        s = np.sign(dp_pa) * np.sqrt(np.abs(dp_pa)) / UNIT
        return np.asarray(FLOW * through(self.theta[1 + k], jnp.asarray(w), jnp.asarray(s)))


def learned_chamber(front: Front, data: ChamberData, at: Working, c: int) -> Hybrid:
    """Collocation, then free runs."""
    nominal = np.log(at.machine.beta_nominal_pa / 1e9)
    keys = jax.random.split(jax.random.PRNGKey(c), 2)
    theta: Any = [jnp.array(nominal), net(keys[0]), net(keys[1])]
    every, sign = front.every, jnp.asarray(data.sign)
    rows = smooth(data.rows, front.dt_s)[every]
    rate = at.rate[:, c] / MPA
    state, few = optax.adam(1.0).init(theta), at.steady.astype(float)
    all_rows = (at.p_pa[:, c] / MPA, rows, rate, few)
    rng = np.random.default_rng(c)
    for k in range(MATCHING):
        some = rng.integers(0, len(rate), ROWS)
        drawn, share = (values[some] for values in all_rows), k / MATCHING
        theta, state = one_step(matching, RATES[0], theta, state, share, sign, *drawn)
    return Hybrid(_free_runs(front, data, theta))


def _free_runs(front: Front, data: ChamberData, theta: Any) -> Any:
    rng, sign = np.random.default_rng(0), jnp.asarray(data.sign)
    start = smooth(data.p_pa[:, None], front.dt_s * 8e-3 / FAST_S)[:, 0] / MPA
    state = optax.adam(1.0).init(theta)
    for k in range(RUNNING):
        first = rng.integers(0, len(start) - WINDOW - 1, BATCH)
        rows = data.rows[first[:, None] + np.arange(WINDOW + 1)]
        at = first[:, None] + EVERY * (1 + np.arange(WINDOW // EVERY))
        measured, share = data.p_pa[at] / MPA, k / RUNNING
        theta, state = one_step(
            running, RATES[1], theta, state, share, sign, start[first], rows, measured
        )
    return theta


class HybridOde:
    """One per chamber."""

    def name(self) -> str:
        """Its row."""
        return "universal ODE (jax)"

    def learn(self, train: Record) -> Learned:
        """Nets and moduli."""
        front = Front(train)
        rows, data = front.rows(), chambers(front)
        models = [learned_chamber(front, d, rows, c) for c, d in enumerate(data)]
        names = [e.name for e in train.machine.edges]
        where: dict[str, tuple[int, int]] = {}
        for c, d in enumerate(data):
            where |= {names[e]: (c, k) for k, e in enumerate(d.edges)}
        beta = np.array([model.beta_pa for model in models])

        def flow(edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
            c, k = where[edge]
            return models[c].flow(k, np.asarray(w_v, float), np.asarray(dp_pa, float))

        return Learned(lambda test: predicted(test, flow, beta), flow, None, beta)


METHODS = (HybridOde(),)
