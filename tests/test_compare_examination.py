"""Examining a model on simulated plants: free run, correlations, CUSUM, places, extra flows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from rtid.compare import (
    FREE_RUN,
    HORIZONS_S,
    CandidateMap,
    Examination,
    ExtraFlowError,
    NoFreeRunError,
    NoSuchBlockError,
    against_signals,
    block_rows,
    blocks_in_span,
    compare,
    correlations,
    cusums,
    examine,
    learned,
    simulate,
    spans_of_block,
)
from rtid.compare.comparison import Comparison, Intervals
from rtid.compare.cusum import factor, recursive_residuals
from rtid.compare.motion import _roughness, _solve, smoothed
from rtid.compare.tables import CAUSES, NEVER, cause_of
from rtid.estimator.chunk import to_chunk
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.published import publish
from rtid.estimator.record import RecordFit, fit_record
from rtid.model import POSITION, Grid, Signal, Term
from rtid.model import Machine as Declared
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate as run_plant
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.units import Z95
from tests.replays import shared_replays  # noqa: F401
from tests.test_other_plants import plant as other_plant

SEEN_S = 25.0
LEAK_M3SPPA = 0.4e-12


@dataclass(frozen=True)
class Machine:
    """A plant, learned on 25 s of 35 s."""

    model: Declared
    fit: RecordFit
    flowmap: FlowMap
    candidate: CandidateMap
    seen: FloatArray
    new: FloatArray


def learn(plant: SimulatedPlant, seed: int, duration_s: float, seen_s: float) -> Machine:
    run = run_plant(plant, "rich", seed=seed, duration_s=duration_s)
    model = declared_model(run.plant, seed=seed)
    chunk = to_chunk(model, run.samples, 0)
    parts = chunk[: round(seen_s * 1e3)], chunk[round(seen_s * 1e3) :]
    fit = fit_record(model, parts[0])
    flowmap = publish(fit.solution)
    return Machine(model, fit, flowmap, learned(fit, flowmap), *parts)


@pytest.fixture(scope="module")
def machine() -> Machine:
    return learn(draw(2), 2, 35.0, SEEN_S)


@pytest.fixture(scope="module")
def seen(machine: Machine) -> Examination:
    return examine(machine.model, machine.candidate, machine.seen, seen=True)


@pytest.fixture(scope="module")
def new(machine: Machine, seen: Examination) -> Examination:
    return examine(machine.model, machine.candidate, machine.new, before=seen.equation)


def smooth_valves(seed: int) -> SimulatedPlant:
    """A random machine whose maps six terms per block can follow: what is left is noise."""
    plant = draw(seed)
    valves = tuple(
        replace(v, deadband_v=0.0, corner_v=0.0, ripple=0.0, curve_1pv=0.03) for v in plant.valves
    )
    return replace(plant, valves=valves, controller=plant.controller._replace(deadband_v=0.0))


@pytest.fixture(scope="module")
def clean() -> list[tuple[Machine, Comparison]]:
    """Several clean records with what the fit leaves of them."""
    return [explained(seed) for seed in range(6)]


def explained(seed: int) -> tuple[Machine, Comparison]:
    m = learn(smooth_valves(seed), seed, 30.0, 30.0)
    return m, compare(m.model, m.candidate, m.seen, seen=True)


def leaking(chunk: FloatArray, model: Declared, from_s: float) -> FloatArray:
    """The record of a machine whose chamber a loses oil to the outside from an instant on.

    The pressures are as they were; what the piston has not received shows in its position.  So
    chamber b, which it compresses less, gets the flow that a has lost in the ratio of the areas.
    """
    x, p = (2 + model.column(name) for name in ("x", "p_a"))
    lost = np.where(chunk[:, 0] >= from_s, LEAK_M3SPPA * chunk[:, p] * 1e-3, 0.0)
    found = chunk.copy()
    found[:, x] -= np.cumsum(lost) / model.chambers[0].area_m2
    return found


def test_a_clean_plant_is_explained_to_the_floor(seen: Examination) -> None:
    assert (seen.equation.residual_share < 0.002).all()
    innovation = seen.equation.intervals.own
    variance = np.nanmean(innovation**2)
    assert variance == pytest.approx(1.0, abs=0.05)


def test_free_run_fits_where_the_map_is_valid(seen: Examination) -> None:
    run = seen.simulations[FREE_RUN]
    assert (run.fit_percent > 95.0).all()
    assert run.predicted[1:].all()
    assert sum(run.stops.values()) == 0
    assert seen.no_free_run == ""


def test_the_shorter_the_horizon_the_better_the_fit(new: Examination) -> None:
    """On data that the fit has not seen; restarts bring the sensors' noise with them."""
    fits = np.array([new.simulations[name].fit_percent for name in HORIZONS_S])
    assert (np.diff(fits, axis=0) > -0.1).all()
    assert (fits[-1] > fits[0]).all()
    starts = [(new.simulations[name].status == 0).sum() for name in HORIZONS_S]
    assert starts == [1, 10, 100]


def test_a_wrong_map_drifts_away_and_restarts_bring_it_back(machine: Machine) -> None:
    wrong = replace(machine.candidate, theta=1.1 * machine.candidate.theta)
    fits = [simulate(machine.model, wrong, machine.seen, n).fit_percent.mean() for n in HORIZONS_S]
    assert fits[0] + 5 < fits[1] + 3 < fits[2]
    right = simulate(machine.model, machine.candidate, machine.seen, FREE_RUN)
    assert fits[0] < right.fit_percent.mean() - 20


def test_the_smoother_is_a_kalman_smoother() -> None:
    """The same as filterpy's RTS pass over x_k = 3 x_k-1 - 3 x_k-2 + x_k-3 + noise."""
    rng, n, wc = np.random.default_rng(0), 120, 0.3
    t = np.linspace(0.0, 0.119, n)
    x = np.sin(20 * t) + 0.05 * rng.standard_normal(n)
    own = _solve(_roughness(t), x, np.ones(n, bool), wc)
    kf = KalmanFilter(dim_x=3, dim_z=1)
    kf.F = np.array([[3.0, -3.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    kf.H, kf.R = np.array([[1.0, 0.0, 0.0]]), np.array([[1.0]])
    kf.Q = np.diag([wc**6, 0.0, 0.0])
    kf.P, kf.x = 1e8 * np.eye(3), np.zeros((3, 1))
    kf.update(x[0])
    means, covs = [kf.x.copy()], [kf.P.copy()]
    for z in x[1:]:
        kf.predict()
        kf.update(z)
        means.append(kf.x.copy())
        covs.append(kf.P.copy())
    smooth = kf.rts_smoother(np.array(means), np.array(covs))[0][:, 0, 0]
    np.testing.assert_allclose(own, smooth, atol=1e-4)


def test_the_smoother_finds_its_bandwidth() -> None:
    rng, t = np.random.default_rng(1), np.linspace(0.0, 7.999, 8000)
    x = 0.25 + 0.05 * np.sin(9 * t) + 2e-4 * np.sin(60 * t)
    measured = rng.random(len(t)) < 0.5
    found = smoothed(t, x + 1e-5 * rng.standard_normal(len(t)), measured)
    assert np.sqrt(np.mean((found - x)[50:-50] ** 2)) < 4e-6


@pytest.mark.long
@pytest.mark.slow
def test_bands_hold_95_percent_of_the_lags_of_clean_records(
    clean: list[tuple[Machine, Comparison]],
) -> None:
    """Twelve of them."""
    own, inputs = [], []
    for m, part in [*clean, *map(explained, range(6, 12))]:
        found = correlations(m.model, part)
        own += [c.outside for c in found if c.itself]
        inputs += [c.outside for c in found if not c.itself]
    assert 0.03 < np.mean(own) < 0.09
    assert np.mean(inputs) < 0.06


def coloured(rng: np.random.Generator, n: int, pole: float) -> FloatArray:
    noise, found = rng.standard_normal(n), np.zeros(n)
    for k in range(1, n):
        found[k] = pole * found[k - 1] + noise[k]
    return found


def pretended(model: Declared, e: FloatArray, u: FloatArray) -> Comparison:
    """A comparison with given innovations of both chambers and a given command."""
    n = len(e)
    values = np.zeros((n, len(model.signals)))
    values[:, model.column("u")] = u
    cell, both = np.full((n, len(model.edges)), -1), np.column_stack([e, e])
    inner = Intervals(np.linspace(0.0, 1e-3 * n, n + 1), cell, both, both, values)
    empty = np.empty((0, 2))
    return Comparison(
        "pretended", np.empty(0), empty, empty, cell[:0], {}, np.ones(2), empty, inner
    )


@pytest.mark.parametrize(("pole_e", "pole_u"), [(0.0, 0.95), (0.8, 0.95)])
def test_bartlett_counts_the_input_s_own_correlation(
    machine: Machine, pole_e: float, pole_u: float
) -> None:
    """Unrelated series: 5 % of the lags lie outside, however coloured both are."""
    rng, share = np.random.default_rng(5), []
    for _ in range(40):
        e, u = coloured(rng, 4000, pole_e), coloured(rng, 4000, pole_u)
        found = correlations(machine.model, pretended(machine.model, e, u), max_lag_s=0.1)
        cross = next(c for c in found if c.signal == "u")
        share.append(0.5 * (cross.outside + cross.feedback))
    assert np.mean(share) == pytest.approx(0.05, abs=0.025)
    if pole_e:
        assert cross.band[len(cross.band) // 2] > 1.5 * Z95 / np.sqrt(4000)


def test_positive_lags_are_missed_effects_and_negative_ones_feedback(machine: Machine) -> None:
    rng = np.random.default_rng(6)
    u = rng.standard_normal(6000)
    after = 0.2 * np.roll(u, 7) + rng.standard_normal(6000)
    found = correlations(machine.model, pretended(machine.model, after, u), max_lag_s=0.05)
    cross = next(c for c in found if c.signal == "u")
    assert cross.lags_s[np.abs(cross.value).argmax()] == pytest.approx(0.007)
    back = correlations(machine.model, pretended(machine.model, np.roll(after, -14), u), 0.05)
    cross = next(c for c in back if c.signal == "u")
    assert cross.lags_s[np.abs(cross.value).argmax()] == pytest.approx(-0.007)


def test_the_boundary_is_that_of_brown_durbin_and_evans() -> None:
    assert factor(0.05) == pytest.approx(0.948, abs=1e-3)
    assert factor(0.01) == pytest.approx(1.143, abs=1e-3)
    assert factor(0.10) == pytest.approx(0.850, abs=1e-3)


def test_recursive_residuals_are_those_of_growing_means() -> None:
    rng = np.random.default_rng(7)
    e, group = rng.standard_normal(200), rng.integers(0, 5, 200)
    w = recursive_residuals(e, group)
    for k in range(200):
        before = e[:k][group[:k] == group[k]]
        if len(before):
            expected = (e[k] - before.mean()) / np.sqrt(1 + 1 / len(before))
            assert w[k] == pytest.approx(expected, abs=1e-10)
        else:
            assert np.isnan(w[k])


def test_cusum_of_white_noise_crosses_as_often_as_it_says(machine: Machine) -> None:
    """5 % over both chambers; the line of Brown, Durbin and Evans is a little conservative."""
    rng, crossed = np.random.default_rng(8), []
    for _ in range(300):
        e, u = rng.standard_normal(3000), np.zeros(3000)
        found = cusums(machine.model, pretended(machine.model, e, u))
        crossed.append(found[0].crosses_s is not None)
    assert 0.005 < np.mean(crossed) < 0.06


@pytest.mark.campaign
def test_cusum_crosses_on_few_clean_records() -> None:
    crossed = []
    for seed in range(60):
        m = learn(smooth_valves(seed), seed, 30.0, 30.0)
        part = compare(m.model, m.candidate, m.seen, seen=True)
        crossed.append(any(c.crosses_s is not None for c in cusums(m.model, part)))
    assert np.mean(crossed) < 0.1


@pytest.mark.parametrize("fitted", [True, False])
def test_cusum_sees_a_leak_that_begins_in_mid_record(machine: Machine, fitted: bool) -> None:
    """Also where the leak was in the data of the fit, which then holds the average of both."""
    model, chunk = machine.model, leaking(machine.seen, machine.model, 15.0)
    candidate = machine.candidate
    if fitted:
        fit = fit_record(model, chunk)
        candidate = learned(fit, publish(fit.solution))
    found = cusums(model, compare(model, candidate, chunk, seen=True))
    first = found[0]
    assert first.crosses_s is not None
    assert first.change_s == pytest.approx(15.0, abs=2.0)
    assert first.crosses_s > 15.0


def test_a_leak_in_the_held_out_part_begins_to_fail_there(
    machine: Machine, seen: Examination
) -> None:
    chunk = leaking(machine.new, machine.model, 30.0)
    part = compare(machine.model, machine.candidate, chunk)
    crossed = [c for c in cusums(machine.model, part, seen.equation) if c.crosses_s is not None]
    assert crossed
    assert all(c.crosses_s is not None and c.crosses_s > 29.0 for c in crossed)


def test_block_to_span_to_block(machine: Machine, seen: Examination) -> None:
    model, part = machine.model, seen.equation
    row = max(block_rows(machine.fit.solution, part), key=lambda r: r.dwell_s)
    spans = spans_of_block(model, part, row.edge, row.i, row.j)
    assert sum(t1 - t0 for t0, t1 in spans) == pytest.approx(row.dwell_s, rel=0.01)
    for t0, t1 in spans:
        visits = {(v.edge, v.i, v.j): v.time_s for v in blocks_in_span(model, part, t0, t1)}
        assert visits[row.edge, row.i, row.j] == pytest.approx(t1 - t0)
        own = [v for v in visits if v[0] == row.edge]
        assert own == [(row.edge, row.i, row.j)]
    between = [(a[1], b[0]) for a, b in pairwise(spans)]
    for t0, t1 in between[:20]:
        inside = blocks_in_span(model, part, t0, t1)
        assert (row.edge, row.i, row.j) not in {(v.edge, v.i, v.j) for v in inside}


def test_a_block_that_does_not_exist_is_named(machine: Machine, seen: Examination) -> None:
    with pytest.raises(NoSuchBlockError, match="no edge 'xy'"):
        spans_of_block(machine.model, seen.equation, "xy", 0, 0)
    with pytest.raises(NoSuchBlockError, match="no block pa:99,0"):
        spans_of_block(machine.model, seen.equation, "pa", 99, 0)


def test_every_block_says_why_it_is_not_identified(machine: Machine, new: Examination) -> None:
    rows = block_rows(machine.fit.solution, new.equation, machine.flowmap)
    assert all((row.reason == "") == (row.status == "valid") for row in rows)
    unseen = [row for row in rows if row.reason == NEVER]
    assert unseen
    assert all(row.rows == 0 and row.residual_rms_m3s >= 0 for row in unseen)
    assert {cause_of(row) for row in rows} >= {CAUSES[0], CAUSES[1], CAUSES[-1]}


def test_shares_of_the_blocks_add_up(machine: Machine, seen: Examination) -> None:
    rows = block_rows(machine.fit.solution, seen.equation)
    for edges in (("pa", "at"), ("pb", "bt")):
        total = sum(row.residual_share for row in rows if row.edge in edges)
        assert 0.5 < total <= 1.0 + 1e-9


def test_the_residual_of_a_leak_depends_on_the_pressure(machine: Machine) -> None:
    chunk = leaking(machine.seen, machine.model, 0.0)
    part = compare(machine.model, machine.candidate, chunk)
    found = {d.signal: d for d in against_signals(machine.model, part)}
    p = found["p_a"]
    slope = np.polyfit(p.centre, p.mean_m3s[:, 0], 1, w=1 / p.error_m3s[:, 0])[0]
    assert slope == pytest.approx(-LEAK_M3SPPA, rel=0.15)
    assert p.explained[0] > 0.2
    assert p.explained[0] > found["x"].explained[0]


def test_error_bars_hold_the_mean_of_a_clean_plant(clean: list[tuple[Machine, Comparison]]) -> None:
    z = [
        d.mean_m3s / d.error_m3s
        for m, part in clean
        for d in against_signals(m.model, part)
        if d.signal == "x"
    ]
    assert np.mean(np.abs(np.concatenate(z)) < Z95) > 0.9


def test_extra_flow_is_the_effect_that_was_missing(machine: Machine) -> None:
    """The leak's own flow on the modelled side: both errors are as if there was none."""
    model, record = machine.model, machine.seen[20000:]
    chunk = leaking(record, model, 20.5)
    lost = np.where(chunk[1:, 0] >= 20.5, LEAK_M3SPPA * chunk[1:, 2 + model.column("p_a")], 0.0)
    a, b = (chamber.area_m2 for chamber in model.chambers)
    extra = np.column_stack([-lost, lost * b / a])
    plain = compare(model, machine.candidate, record)
    without = compare(model, machine.candidate, chunk)
    added = compare(model, machine.candidate, chunk, extra)
    assert without.residual_share[0] > 3 * plain.residual_share[0]
    assert added.residual_share[0] == pytest.approx(plain.residual_share[0], rel=0.1)
    assert added.rho[0] == pytest.approx(plain.rho[0], rel=0.05)
    fits = [
        simulate(model, machine.candidate, chunk, FREE_RUN, extra_flow=flow).fit_percent[0]
        for flow in (None, extra)
    ]
    assert fits[1] > fits[0] + 1.0


def test_an_extra_flow_of_another_length_is_refused(machine: Machine) -> None:
    with pytest.raises(ExtraFlowError, match=r"shape \(3, 2\)"):
        compare(machine.model, machine.candidate, machine.new, np.zeros((3, 2)))


def test_a_plant_without_pressure_has_no_free_run(machine: Machine) -> None:
    chambers = tuple(replace(c, pressure="") for c in machine.model.chambers)
    with pytest.raises(NoFreeRunError, match="chamber a, b has no pressure"):
        simulate(replace(machine.model, chambers=chambers), machine.candidate, machine.new)


def test_a_drive_without_pressures_is_examined_all_the_same() -> None:
    """omega' = 40 u - 4 omega: the equation, its correlations and its CUSUM, but no free run."""
    rng, n = np.random.default_rng(9), 20_000
    decay = Term("decay", (("w", -1.0),), (("speed", 1),), 4.0)
    grid = Grid(np.array([-10.0, -3.0, 3.0, 10.0]), np.array([-1.0, 1.0]))
    model = other_plant("speed", grid, 300.0, Signal("w", POSITION, noise=0.05), (decay,))
    u, w = np.repeat(rng.uniform(-9, 9, n // 80 + 1), 80)[:n], np.zeros(n)
    for k in range(n - 1):
        w[k + 1] = w[k] * np.exp(-4e-3) + 10 * u[k] * (1 - np.exp(-4e-3))
    columns = (np.linspace(0, 1e-3 * (n - 1), n), np.ones(n), u, w + 0.05 * rng.standard_normal(n))
    chunk = np.column_stack(columns)
    fit = fit_record(model, chunk)
    found = examine(model, learned(fit, publish(fit.solution)), chunk, seen=True)
    assert found.simulations == {}
    assert "speed has no pressure" in found.no_free_run
    assert found.equation.rho[0] == pytest.approx(1.0, abs=0.05)
    assert next(c for c in found.correlations if c.itself).outside < 0.12
    assert found.cusums[0].crosses_s is None


def test_a_position_that_comes_rarely(machine: Machine) -> None:
    """x every 20 ms and interpolated between: the smoother still finds its way."""
    chunk, x = machine.new.copy(), 2 + machine.model.column("x")
    rare = np.arange(0, len(chunk), 20)
    chunk[:, x] = np.interp(chunk[:, 0], chunk[rare, 0], chunk[rare, x])
    chunk[:, 1] = np.isin(np.arange(len(chunk)), rare)
    found = examine(machine.model, machine.candidate, chunk)
    assert (found.simulations[FREE_RUN].fit_percent > 80).all()
    step = found.correlations[0].lags_s[0]
    assert step == pytest.approx(0.02)


def test_nothing_to_examine(machine: Machine) -> None:
    for n in (0, 1, 5):
        found = examine(machine.model, machine.candidate, machine.new[:n])
        assert found.equation.t_s.shape == (0,)
        assert found.correlations == []
