"""Plants of the general form (1), xdot = phi(x)' theta + f(u, x): the same engine, other names."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.estimator.published import publish
from rtid.estimator.solution import Solution, solve
from rtid.estimator.state import build
from rtid.model import (
    COMMAND,
    COMMAND_ONLY,
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

ONE = np.array([-1.0, 1.0])  # the single interval of a second argument that is not there


def plant(
    name: str,
    grid: Grid,
    size: float,
    state: Signal,
    terms: tuple[Term, ...],
    others: tuple[Signal, ...] = (),
    max_gap_s: float = 0.05,
) -> Machine:
    """xdot = f(u) + terms."""
    signs = ((name, 1),)
    drive = Edge("f", NONE, NONE, "u", 1, grid, -np.inf, size, 1.0, TAYLOR, COMMAND_ONLY, (), signs)
    return Machine(
        signals=(Signal("u", COMMAND), state, *others),
        chambers=(Chamber(name, NONE, 1.0, 1, 0.0),),
        edges=(drive,),
        position=state.name,
        beta_nominal_pa=1.0,
        beta_bounds_pa=(0.5, 2.0),
        gates=Gates(max_gap_s=max_gap_s, max_sd_share=0.01),
        terms=terms,
    )


def learned(model: Machine, t_s: FloatArray, *columns: FloatArray) -> Solution:
    state = build(model)
    state.advance(np.column_stack([t_s, np.ones(len(t_s)), *columns]))
    return solve(model, state)


def steps(rng: np.random.Generator, low: float, high: float, each: int, n: int) -> FloatArray:
    return np.repeat(rng.uniform(low, high, n // each + 1), each)[:n]


def test_electric_drive_with_a_nonlinear_amplifier() -> None:
    """omega' = 300 a(u) - 4 omega - load, a with dead zone and saturation."""
    rng, n, dt = np.random.default_rng(3), 60_000, 1e-3

    def amplifier(u: FloatArray) -> FloatArray:
        return np.asarray(np.tanh(0.35 * np.sign(u) * np.maximum(np.abs(u) - 1.0, 0.0)))

    u = steps(rng, -9, 9, 80, n)
    load = 20 * np.sin(2 * np.pi * 0.3 * dt * np.arange(n))
    omega = np.zeros(n)
    for k in range(n - 1):  # exact for the held command, the load at mid-step
        rate = 300 * amplifier(u[k]) - 0.5 * (load[k] + load[k + 1])
        omega[k + 1] = omega[k] * np.exp(-4 * dt) + rate / 4 * (1 - np.exp(-4 * dt))
    measured = omega + 0.05 * rng.standard_normal(n)
    model = plant(
        "speed",
        Grid(np.array([-10, -7, -5, -3, -2, -1.0, 1.0, 2, 3, 5, 7, 10.0]), ONE),
        300.0,
        Signal("omega", POSITION, noise=0.05),
        (
            Term("viscous", (("omega", -1.0),), (("speed", 1),), 1.0),
            Term("load", (("load", -1.0),), (("speed", 1),), 1.0),
        ),
        (Signal("load", POSITION, noise=0.01),),
    )
    found = learned(model, dt * np.arange(n, dtype=np.float64), u, measured, load)
    sd = np.sqrt(np.diag(found.terms_cov))
    print(f"viscous {found.terms[0]:.3f} +- {sd[0]:.3f}, load {found.terms[1]:.4f} +- {sd[1]:.4f}")
    assert found.terms[0] == pytest.approx(4.0, abs=max(4 * sd[0], 0.02))
    assert found.terms[1] == pytest.approx(1.0, abs=max(4 * sd[1], 0.005))
    at = np.array([-8.0, -6, -4, -2.5, 0.0, 2.5, 4, 6, 8])
    values = [_flow(found, u0) for u0 in at]
    np.testing.assert_allclose(values, 300 * amplifier(at), atol=3.0)  # 1 % of full scale


def test_heated_room() -> None:
    """T' = power(u) / C - h (T - T_outside) / C: a sample every 10 s, for four days."""
    rng, n, dt = np.random.default_rng(4), 34_560, 10.0
    t = dt * np.arange(n, dtype=np.float64)
    u = steps(rng, 0, 10, 180, n)
    outside = 5 + 6 * np.sin(2 * np.pi * t / 86_400) + 2 * np.sin(2 * np.pi * t / 30_000)
    loss_1ps = 1 / 9000.0

    def heating(v: FloatArray) -> FloatArray:
        return np.asarray(3e-3 * (1 - np.exp(-0.3 * np.maximum(v - 0.8, 0.0))))

    inside = np.full(n, 18.0)
    keep = np.exp(-loss_1ps * dt)
    for k in range(n - 1):
        rest = 0.5 * (outside[k] + outside[k + 1]) + heating(u[k]) / loss_1ps
        inside[k + 1] = rest + (inside[k] - rest) * keep
    measured = inside + 0.02 * rng.standard_normal(n)
    model = plant(
        "room",
        Grid(np.array([0.0, 0.8, 2, 4, 6, 8, 10]), ONE),
        3e-3,
        Signal("inside", POSITION, noise=0.02),
        (Term("loss", (("inside", -1.0), ("outside", 1.0)), (("room", 1),), 1e-4),),
        (Signal("outside", POSITION, noise=0.01),),
        max_gap_s=60.0,
    )
    found = learned(model, t, u, measured, outside)
    sd = float(np.sqrt(found.terms_cov[0, 0]))
    print(f"time constant {1 / found.terms[0]:.0f} s, sd {100 * sd / loss_1ps:.2f} %")
    assert found.terms[0] == pytest.approx(loss_1ps, abs=max(4 * sd, 0.01 * loss_1ps))
    at = np.array([0.4, 1.4, 3.0, 5.0, 7.0, 9.0])
    values = [_flow(found, u0) for u0 in at]
    np.testing.assert_allclose(values, heating(at), atol=3e-5)  # 1 % of full scale


def _flow(solution: Solution, u: float) -> float:
    """The learned f at u, from the block that holds it."""
    border = solution.model.edges[0].grid.u_v
    i = int(np.searchsorted(border, u, side="right")) - 1
    block = solution.block(0, i, 0)
    assert block is not None
    xi = (2 * u - border[i] - border[i + 1]) / (border[i + 1] - border[i])
    return float(np.array([1.0, xi, 0.0, xi * xi, 0.0, 0.0]) @ block.theta)


def test_the_published_map_of_such_a_plant() -> None:
    """There is no orifice law to fill it: what is learned is what is published."""
    model = plant("x", Grid(np.linspace(-1, 1, 5), ONE), 1.0, Signal("y", POSITION, noise=0.1), ())
    rng = np.random.default_rng(5)
    u = steps(rng, -1, 1, 20, 4000)
    y = 0.1 * rng.standard_normal(4000) + np.concatenate([[0], np.cumsum(1e-3 * np.sin(u))[:-1]])
    found = learned(model, 1e-3 * np.arange(4000, dtype=np.float64), u, y)
    published = publish(found).edges[0]
    assert published.theta.shape == (4, 1, 6)
    np.testing.assert_allclose(published.flow(0.25, 0.0), _flow(found, 0.25), rtol=1e-9)
