"""Random declarations and signals: the regression does not care whether they obey physics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.model import (
    COMMAND,
    MODE,
    POSITION,
    PRESSURE,
    SHAPES,
    TAYLOR,
    Chamber,
    Edge,
    Filter,
    Gates,
    Grid,
    Lag,
    Machine,
    Signal,
    Term,
)
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate

ENDS = (
    ("pa", "p_s", "p_a", 1),
    ("at", "p_a", "p_t", -1),
    ("pb", "p_s", "p_b", -1),
    ("bt", "p_b", "p_t", 1),
    ("ab", "p_a", "p_b", -1),
)
NAMES = ("u", "p_a", "p_b", "p_s", "p_t", "x")


@dataclass(frozen=True, eq=False)
class Case:
    """A declaration and a record for it."""

    model: Machine
    t_s: FloatArray
    values: FloatArray
    flags: FloatArray

    @property
    def chunk(self) -> FloatArray:
        return np.column_stack([self.t_s, self.flags, self.values])


def draw_case(
    seed: int,
    form: str = "integral",
    *,
    chambers: int = 2,
    n: int = 1500,
    blocks: int = 3,
    chatter_pa: float = 5e3,
    jitter: float = 0.0,
    row_every: int = 1,
    faults: int = 0,
    reverse: bool = False,
    terms: int = 0,
    basis: str = TAYLOR,
    modes: bool = False,
    recovery_s: float = 0.0,
) -> Case:
    """A random case; faults: so many each of gaps, NaN, values out of range and off the grid."""
    rng = np.random.default_rng([seed, 77])
    model = draw_model(rng, form, chambers, blocks, -1 if reverse else 1)
    model = replace(
        model,
        terms=tuple(draw_term(rng, model, k) for k in range(terms)),
        edges=tuple(replace(edge, basis=basis) for edge in model.edges),
        gates=replace(model.gates, recovery_s=recovery_s),
    )
    model = with_modes(model) if modes else model
    steps_us = np.rint(1e3 * (1 + jitter * rng.uniform(-1, 1, n)))
    t = 10.0 + 1e-6 * np.cumsum(steps_us)  # stamps are whole microseconds
    names = [s.name for s in model.signals]
    drawn = draw_signals(rng, t)
    values = drawn[:, [NAMES.index(name) for name in names if name != "mode"]]
    if modes:
        mode = np.repeat(rng.integers(0, 3, n // 100 + 1), 100)[:n]
        values = np.column_stack([values, mode])
    noisy = [j for j, name in enumerate(names) if name.startswith("p_")]
    values[:, noisy] += chatter_pa * rng.standard_normal((n, len(noisy)))
    flags = np.zeros(n)
    flags[::row_every] = 1.0
    flags[0] = 3.0
    for k in rng.choice(np.arange(50, n - 50), size=4 * faults, replace=False).reshape(4, -1).T:
        flags[k[0]] += 2.0
        values[k[1], rng.integers(len(names))] = np.nan
        values[k[2], names.index("x")] = 7.0
        values[k[3], names.index("p_s")] = 19e6
    if faults:
        t[n // 2 :] += 0.2
    return Case(model, t, values, flags)


def draw_model(
    rng: np.random.Generator, form: str, chambers: int, blocks: int, way: int = 1
) -> Machine:
    """A declaration with grids of unequal spacing."""
    sizes = rng.uniform(0.7, 1.3, 4)
    ends = ENDS if chambers == 2 else ENDS[:2]
    noise = 5e3 * sizes[0]
    limits = {"p_s": (0.0, np.inf)}  # entrained air needs a pressure that is never zero
    pressures = [
        Signal(name, PRESSURE, "Pa", noise, 150.0, *limits.get(name, ())) for name in NAMES[1:5]
    ]
    both = (
        Chamber("a", "p_a", 2e-3 * sizes[1], way, 6e-4),
        Chamber("b", "p_b", 1e-3 * sizes[2], -way, 9e-4),
    )
    return Machine(
        signals=(
            Signal("u", COMMAND, "V"),
            *pressures,
            Signal("x", POSITION, "m", 1e-5, 7e-6, -1.0, 1.0),
        ),
        chambers=both[:chambers],
        edges=tuple(_draw_edge(rng, *end, blocks, way) for end in ends),
        position="x",
        beta_nominal_pa=8e8 * sizes[3],
        beta_bounds_pa=(2e8, 1.6e9),
        lag=Lag(float(rng.choice([0.0, 1.3e-3, 8e-3])), 2e-4),
        filter=Filter(2 * np.pi * rng.uniform(5, 20), rng.uniform(0.5, 0.95), 50.0),
        gates=Gates(hysteresis=float(rng.choice([0.0, 0.05, 0.2]))),
        form=form,
    )


def with_modes(model: Machine) -> Machine:
    """Three modes: all edges, a regenerative one with the cross-port edge, one without it."""
    allowed = {"ab": (0, 1), "pb": (0, 2), "bt": (0, 2)}
    return replace(
        model,
        signals=(*model.signals, Signal("mode", MODE, minimum=0.0, maximum=2.0)),
        edges=tuple(replace(edge, modes=allowed.get(edge.name, ())) for edge in model.edges),
        mode="mode",
    )


def draw_term(rng: np.random.Generator, model: Machine, k: int) -> Term:
    """A shared flow of the pressures and the position; every shape and kind of rate in turn."""
    weights = tuple((name, float(rng.normal())) for name in NAMES[1:5])
    position = ("x", float(1e7 * rng.normal()))
    signs = tuple((c.name, int(rng.choice([-1, 0, 1]))) for c in model.chambers[1:])
    signs = (("a", 1), *signs)
    if k % 6 == 4:  # extra volume: the rate of a pressure
        return Term(f"term {k}", (("p_a", 1.0),), signs, 1e-13, rate=True)
    if k % 6 == 5:  # entrained air: -V d(-1 / p)/dt
        positive = (("p_s", 1.0),)
        return Term(f"term {k}", positive, signs, 1e5, 1e5, "inverse", rate=True, volume="a")
    shape = SHAPES[k % 6 % 3]
    scale = 1e-8 if shape == "root" else 1e-11
    return Term(f"term {k}", (*weights, position), signs, scale, float(rng.normal()), shape)


def _draw_edge(
    rng: np.random.Generator, name: str, source: str, sink: str, sign: int, blocks: int, way: int
) -> Edge:
    widths = rng.uniform(0.5, 2.0, blocks - 1)
    u = np.concatenate([[0.8], 0.8 + 6.0 * np.cumsum(widths) / widths.sum(), [12.0]])
    widths = rng.uniform(0.5, 2.0, blocks)
    dp = np.concatenate([[-9e6], -2.5e6 + 7e6 * np.cumsum(widths) / widths.sum(), [9e6]])
    safe = float(rng.uniform(0.8, 1.2))
    return Edge(name, source, sink, "u", way * sign, Grid(u, dp), safe, 2e-4, 5e5)


def draw_signals(rng: np.random.Generator, t: FloatArray) -> FloatArray:
    """u with steps, pressures and position as random sums of sines: (n, 6) in the order NAMES."""

    def wave(size: float, low: float, high: float) -> FloatArray:
        rates, phases = rng.uniform(low, high, 4), rng.uniform(0, 2 * np.pi, 4)
        return size * np.sin(2 * np.pi * np.outer(t, rates) + phases).mean(axis=1)

    steps = rng.choice([-2.0, -0.5, 0.0, 0.5, 2.0], size=int((t[-1] - t[0]) / 0.05) + 2)
    u = np.clip(wave(9.0, 0.3, 3) + steps[((t - t[0]) / 0.05).astype(int)], -10, 10)
    u = np.round(u / 3e-4) * 3e-4
    p_a, p_b = 3e6 + wave(3e6, 0.5, 8), 2.5e6 + wave(3e6, 0.5, 8)
    p_s, p_t = 7e6 + wave(1e6, 0.1, 1), 1e5 + wave(1e5, 0.1, 1)
    return np.stack([u, p_a, p_b, p_s, p_t, 0.25 + wave(0.2, 0.3, 2)], axis=1)


def plant_case(
    seed: int, form: str, cross_port: bool = False, duration_s: float | None = None
) -> Case:
    """A short record of a random simulated machine with a coarse grid, full sensor noise."""
    plant = draw(seed, cross_port=cross_port)
    duration_s = duration_s or (3.0 if form == "integral" else 10.0)
    samples = simulate(plant, "rich", seed, duration_s).samples
    u = np.array([1.0, 2.0, 3.0, 4.5, 10.0])
    grids = dict.fromkeys(plant.edges, Grid(u, np.array([-1.0, 1.0, 2.5, 4.0, 6.0, 10.0]) * 1e6))
    if cross_port:
        grids["ab"] = Grid(u, np.array([-9.0, -2.0, 0.0, 2.0, 9.0]) * 1e6)
    model = declared_model(plant, grid=grids, form=form)
    model = replace(model, filter=Filter(rows_per_s=100.0))
    t_s = np.asarray(samples.t_us * 1e-6, np.float64)
    return Case(model, t_s, samples.values, samples.flags.astype(float))
