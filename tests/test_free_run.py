"""The free run against scipy's integrator on the same equation, and what it does at the edges."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rtid.compare.reference import GainTable, ReferenceMap
from rtid.estimator.flowmap import VALID, EdgeMap, FlowMap
from rtid.estimator.state import build, nominal_weights
from rtid.estimator.windows import OVERLAP
from rtid.kernels import free_run as module
from rtid.kernels import map_point
from rtid.kernels.free_run import BEYOND, GAP, INSIDE, OFF_GRID, RAN_AWAY, START
from rtid.model import Grid, Lag, Machine, Term
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.simulated_plant import SimulatedPlant

GRID = Grid(
    np.array([1.0, 1.5, 2.0, 2.75, 3.5, 5.0, 7.0]),
    np.array([-1.0, 0.0, 0.1, 0.3, 1.0, 2.0, 3.5, 5.0, 8.0]) * 1e6,
)
TERMS = (
    Term("leak", (("p_a", 1.0), ("p_b", -1.0)), (("a", -1), ("b", 1)), 1e-12),
    Term("orifice", (("p_b", 1.0), ("p_tank", -1.0)), (("b", -1),), 2e-9, shape="root"),
    Term("relief", (("p_a", 1.0),), (("a", -1),), 2e-11, -2.5e6, "hinge"),
    Term("hose", (("p_a", 1.0),), (("a", 1),), 1e-13, rate=True),
    Term("air", (("p_b", 1.0),), (("b", 1),), 2e3, shape="inverse", rate=True, volume="b"),
    Term("sag", (("p_supply", 1.0),), (("a", 1),), 1e-13, rate=True),
)
THETA_TERMS = np.array([2.0, 0.5, 1.0, 1.5, 0.8, 1.0])


def machine(terms: tuple[Term, ...] = (), lag_s: float = 1.3e-3) -> tuple[Machine, FlowMap]:
    """A model and a map whose cells do not meet: the blending has work to do."""
    plant = SimulatedPlant()
    model = declared_model(plant, grid=GRID, lag=Lag(lag_s, 0.0))
    told = tuple(replace(s, minimum=1e3) if s.name == "p_b" else s for s in model.signals)
    model = replace(model, signals=told, terms=terms)
    w = np.arange(0.0, 10.01, 0.02)
    tables = {
        edge: GainTable(w, np.ones(1), (plant.flow(edge, w, 4e6) / 2e3)[:, None])
        for edge in plant.edges
    }
    theta = ReferenceMap("truth", tables).theta_cells(model)
    theta *= 1.0 + 0.05 * np.random.default_rng(0).standard_normal((len(theta), 1))
    shape, edges = GRID.shape, []
    for k, edge in enumerate(model.edges):
        own = theta[k * np.prod(shape) : (k + 1) * np.prod(shape)].reshape(*shape, 6)
        cov, status = np.zeros((*shape, 6, 6)), np.full(shape, VALID)
        edges.append(EdgeMap(edge.name, GRID, edge.safe_band_v, own, cov, status, {}))
    return model, FlowMap(tuple(edges))


def signals(n: int = 200, dt: float = 1e-3) -> FloatArray:
    """Command steps both ways, wandering supply: u, p_a, p_b, p_supply, p_tank, x, v."""
    t = dt * np.arange(n)
    u = np.resize(np.repeat([3.5, -3.0, 2.2, 0.5, -2.5], 12), n)
    x = 0.25 + 0.002 * np.sin(12 * t)
    supply, tank = 6.5e6 + 3e5 * np.sin(40 * t), 1e5 + 2e4 * np.cos(30 * t)
    columns = (t, np.ones(n), u, np.full(n, 3e6), np.full(n, 2e6), supply, tank, x, 0 * t)
    return np.column_stack(columns)


def run(
    model: Machine,
    flowmap: FlowMap,
    chunk: FloatArray,
    period_s: float = np.inf,
    plain: bool = False,
) -> tuple[FloatArray, np.ndarray]:
    engine = build(model, nominal_weights(model)).engine
    engine[0]["term_theta"][: len(model.terms)] = THETA_TERMS[: len(model.terms)]
    if plain:
        engine = engine.view(np.recarray)
    pressure, status = np.empty((len(chunk), 2)), np.zeros(len(chunk), np.int64)
    x = chunk[:, 2 + model.column(model.position)].copy()
    compliance = np.array([1 / 800e6, 1 / 900e6])
    module.free_run(
        engine, flowmap.theta_cells(), compliance, OVERLAP, chunk, x, period_s, pressure, status
    )
    return pressure, status


def truth(model: Machine, flowmap: FlowMap, chunk: FloatArray, lag_s: float) -> FloatArray:
    """The same by scipy, interval after interval, from the published map itself."""
    c = SimulatedPlant().constants
    area = np.array([c.area_a_m2, -c.area_b_m2])
    v0 = np.array([c.v0_a_m3, c.v0_b_m3 + c.area_b_m2 * c.stroke_m])
    theta, p = np.array([1 / 800e6, 1 / 900e6]), chunk[0, 3:5].copy()
    leak, orifice, relief, hose, air, sag = THETA_TERMS * [1e-12, 2e-9, 2e-11, 1e-13, 2e3, 1e-13]
    w0, found = float(chunk[0, 2]), [p]

    def rates(t: float, p: FloatArray, a: FloatArray, b: FloatArray, w0: float) -> FloatArray:
        s = (t - a[0]) / (b[0] - a[0])
        u = a[2] + (w0 - a[2]) * np.exp(-(t - a[0]) / lag_s) if lag_s else a[2]
        supply, tank, x = (a[j] + s * (b[j] - a[j]) for j in (5, 6, 7))
        q = {
            name: float(flowmap.flow(name, w, dp)) if w > 1.0 else 0.0
            for name, w, dp in (
                ("pa", u, supply - p[0]),
                ("at", -u, p[0] - tank),
                ("pb", -u, supply - p[1]),
                ("bt", u, p[1] - tank),
            )
        }
        v = (b[7] - a[7]) / (b[0] - a[0])
        flow = np.array([q["pa"] - q["at"], q["pb"] - q["bt"]]) - area * v
        matrix = np.diag((v0 + area * x) * theta)
        if model.terms:
            inner = leak * (p[0] - p[1])
            flow += [-inner - relief * max(0.0, p[0] - 2.5e6), inner]
            flow[1] -= orifice * np.sign(p[1] - tank) * np.sqrt(abs(p[1] - tank))
            flow[0] -= sag * (b[5] - a[5]) / (b[0] - a[0])
            matrix += np.diag([hose, air * (v0[1] + area[1] * x) / p[1] ** 2])
        return np.asarray(np.linalg.solve(matrix, flow))

    for a, b in pairwise(chunk):
        done = solve_ivp(rates, (a[0], b[0]), p, "DOP853", args=(a, b, w0), rtol=1e-9, atol=1e-3)
        p = done.y[:, -1]
        w0 = a[2] + (w0 - a[2]) * np.exp(-(b[0] - a[0]) / lag_s) if lag_s else a[2]
        found.append(p)
    return np.array(found)


@pytest.mark.first_of(2)
@pytest.mark.parametrize("terms", [(), TERMS])
@pytest.mark.parametrize("lag_s", [0.0, 1.3e-3])
def test_free_run_is_the_solution_of_the_equation(terms: tuple[Term, ...], lag_s: float) -> None:
    model, flowmap = machine(terms, lag_s)
    chunk = signals(60)
    pressure, status = run(model, flowmap, chunk)
    assert status[0] == START
    assert set(status[1:]) == {INSIDE}
    assert np.ptp(pressure[:, 0]) > 3e5
    np.testing.assert_allclose(pressure, truth(model, flowmap, chunk, lag_s), rtol=1e-6)


def as_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every function of the kernel as Python."""
    for place in (module, map_point):
        for name, value in vars(place).copy().items():
            if hasattr(value, "py_func"):
                monkeypatch.setattr(place, name, value.py_func)


def test_compiled_and_plain_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    model, flowmap = machine(TERMS)
    chunk = signals(30)
    compiled = run(model, flowmap, chunk, 0.01)
    as_python(monkeypatch)
    pressure, status = run(model, flowmap, chunk, 0.01, plain=True)
    np.testing.assert_allclose(pressure, compiled[0], rtol=1e-12)
    assert (status == compiled[1]).all()
    assert (status == START).sum() == 3


def test_restarts_take_the_measurement() -> None:
    model, flowmap = machine()
    chunk = signals()
    chunk[:, 3] += 1e4 * np.random.default_rng(0).standard_normal(len(chunk))
    pressure, status = run(model, flowmap, chunk, 0.05)
    starts = np.flatnonzero(status == START)
    assert starts.tolist() == [0, 50, 100, 150]
    np.testing.assert_array_equal(pressure[starts], chunk[starts, 3:5])


def test_a_gap_or_a_bad_sample_begins_anew_and_says_so() -> None:
    model, flowmap = machine()
    chunk = signals()
    chunk[60, 1] = 3  # a gap before this sample
    chunk[100, 5] = np.nan
    pressure, status = run(model, flowmap, chunk)
    assert status[60] == GAP
    assert (status[[100, 101]] == GAP).all()
    assert np.isnan(pressure[[60, 100, 101]]).all()
    assert np.isfinite(np.delete(pressure, [60, 100, 101], axis=0)).all()
    assert np.abs(pressure[61] - chunk[60, 3:5]).max() < 5e5


def test_a_command_off_the_grid_stops_the_run() -> None:
    model, flowmap = machine()
    chunk = signals()
    chunk[50:60, 2] = 9.0
    pressure, status = run(model, flowmap, chunk)
    assert (status == OFF_GRID).sum() == pytest.approx(10, abs=2)
    assert (np.isnan(pressure[:, 0]) == (status == OFF_GRID)).all()


def test_beyond_the_grid_the_map_goes_on_along_its_tangent() -> None:
    model, flowmap = machine()
    chunk = signals()
    chunk[:, 3] = 8.5e6  # above the supply: dp < -1 MPa
    chunk[:, 2] = 4.0
    pressure, status = run(model, flowmap, chunk)
    assert status[1] == BEYOND
    assert np.isfinite(pressure).all()
    assert pressure[5, 0] < 8.4e6


def test_a_stiff_chamber_takes_more_steps_and_stays_exact() -> None:
    """A wide open valve at a small pressure drop: the pressure follows within 0.1 ms."""
    model, flowmap = machine()
    stiff = FlowMap(tuple(replace(e, theta=30.0 * e.theta) for e in flowmap.edges))
    chunk = signals(12)
    pressure, status = run(model, stiff, chunk)
    assert not set(status) & {GAP, OFF_GRID, RAN_AWAY}
    exact = truth(model, stiff, chunk, 1.3e-3)
    np.testing.assert_allclose(pressure, exact, rtol=0, atol=1.0)  # of 6 MPa


def test_a_map_that_is_no_machine_stops_and_does_not_hang() -> None:
    model, flowmap = machine()
    wild = FlowMap(tuple(replace(e, theta=1e12 * e.theta) for e in flowmap.edges))
    pressure, status = run(model, wild, signals(20))
    assert RAN_AWAY in set(status)
    assert np.isnan(pressure[status == RAN_AWAY]).all()


def test_a_pressure_far_out_of_its_sensor_s_range_begins_anew() -> None:
    """The piston pulled out of a shut chamber: no oil can be at -30 MPa."""
    model, flowmap = machine()
    chunk = signals()
    chunk[:, 2], chunk[:, 7] = 0.0, np.linspace(0.1, 0.4, len(chunk))
    pressure, status = run(model, flowmap, chunk)
    assert (status == RAN_AWAY).sum() > 3
    assert np.nanmin(pressure) > -30e6
    assert np.isfinite(pressure[-1]).all() or status[-1] == RAN_AWAY
