"""Declarations at and beyond the kernels' limits, and records that hardly say anything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.estimator.limits import most_open, unfit
from rtid.estimator.record import fit_record
from rtid.estimator.solution import solve
from rtid.estimator.state import build
from rtid.model import LAPPED, Filter, Grid, Machine, Signal
from rtid.sim.declare import declared_model, uniform_grid
from rtid.sim.run import Sensors, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.estimator.cases import Case, draw_case
from tests.estimator.test_batch import check

WIDE = uniform_grid((-11, 11, 6), (-9e6, 9e6, 4))


def five_edges(safe_band_v: float) -> Machine:
    plant = replace(SimulatedPlant(), directions=(1, -1, -1, 1, -1))
    return declared_model(plant, grid=WIDE, safe_band_v=safe_band_v)


def test_too_many_blocks_open_at_once_are_refused() -> None:
    for safe_band_v, edges in ((1.0, 3), (-np.inf, 5)):
        assert most_open(five_edges(safe_band_v)) == edges
        build(five_edges(safe_band_v))
    model = five_edges(-np.inf)
    six = [*model.edges, replace(model.edges[0], name="sixth")]
    lapped = replace(model, edges=tuple(replace(e, basis=LAPPED) for e in six))
    with pytest.raises(ValueError, match="24 blocks that are open at once; at most 20"):
        build(lapped)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"filter": Filter(zeta=1.0)}, "damping 1: must lie between 0 and 1"),
        ({"signals": 30}, "30 signals; at most 24"),
        ({"grid": Grid(np.linspace(0, 1, 131), np.array([0.0, 1.0]))}, "edges.pa: 131 borders"),
        ({"noise": "x"}, "signals.x: noise and resolution are zero"),
        ({"noise": "p_b"}, "signals.p_b: noise and resolution are zero"),
    ],
)
def test_what_the_kernels_cannot_hold_is_refused(change: dict[str, object], message: str) -> None:
    model = draw_case(0).model
    if "filter" in change:
        model = replace(model, filter=change["filter"])  # type: ignore[arg-type]
    if "signals" in change:
        more = tuple(Signal(f"s{i}", "pressure") for i in range(24))
        model = replace(model, signals=model.signals + more)
    if "grid" in change:
        edges = (replace(model.edges[0], grid=change["grid"]), *model.edges[1:])  # type: ignore[arg-type]
        model = replace(model, edges=edges)
    if "noise" in change:
        signals = tuple(
            replace(s, noise=0.0, resolution=0.0) if s.name == change["noise"] else s
            for s in model.signals
        )
        model = replace(model, signals=signals)
    with pytest.raises(ValueError, match=message):
        build(model)


def test_a_noise_beyond_all_measure_is_no_crash() -> None:
    model = draw_case(0).model
    assert unfit(model.with_noise({model.position: 1e200})) == unfit(model)


@pytest.mark.parametrize("form", ["integral", "carry"])
def test_a_reversal_within_one_sample_changes_all_edges_at_once(form: str) -> None:
    """Without lag, two edges shut and three open in one sample, in the unlucky order of edges."""
    case = draw_case(31, form)
    order = [case.model.edges[i] for i in (4, 1, 2, 0, 3)]
    model = replace(case.model, edges=tuple(order), lag=replace(case.model.lag, nominal_s=0.0))
    values = case.values.copy()
    values[:, 0] = 5.0 * np.sign(np.sin(2 * np.pi * 7 * case.t_s))
    check(Case(model, case.t_s, values, case.flags))


def sensible(model: Machine, chunk: np.ndarray) -> None:
    state = build(model)
    state.advance(np.ascontiguousarray(chunk))
    solution = solve(model, state)
    assert np.isfinite(solution.compliance).all()
    assert (np.diag(solution.compliance_cov) > 0).all()
    assert np.isfinite([block.theta for block in solution.blocks]).all()
    assert np.isfinite(fit_record(model, chunk).solution.rho)


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_hardly_any_sample(n: int) -> None:
    case = draw_case(1)
    sensible(case.model, case.chunk[:n])


def test_no_row_at_all() -> None:
    case = draw_case(1)
    chunk = case.chunk
    chunk[:, 1] = 0.0
    sensible(case.model, chunk)


def standing_still(noise: float, seed: int) -> np.ndarray:
    """20 s with the valves shut; sensor noise in units of the declared one."""
    run = simulate(SimulatedPlant(), "standstill", 1, 0.1)
    rng = np.random.default_rng(seed)
    values = np.tile(run.truth.signals[-1], (20000, 1))
    values += noise * rng.standard_normal(values.shape) * Sensors().noise()
    values[:, 0] = 0.0
    return np.column_stack([1e-3 * np.arange(20000), np.ones(20000), values])


@pytest.mark.parametrize("noise", [1.0, 0.5, 0.0])
def test_standing_still_breaks_nothing(noise: float) -> None:
    for seed in range(5):
        sensible(declared_model(SimulatedPlant()), standing_still(noise, seed))


def test_standing_still_tells_nothing_of_beta() -> None:
    model = declared_model(SimulatedPlant())
    for seed in range(5):
        solution = fit_record(model, standing_still(1.0, seed)).solution
        error = np.abs(solution.compliance - 1 / SimulatedPlant().beta_pa)
        assert (error < 2 * np.sqrt(np.diag(solution.compliance_cov))).all()
