"""Runs of the simulated machine: determinism, sensors, tracking, and the honest declaration."""

import numpy as np
import pytest

from firmware_bridge.samples import GAP, ROW
from rtid.sim.declare import declared_model, uniform_grid
from rtid.sim.random_plants import draw
from rtid.sim.run import EXACT, NAMES, Run, Sensors, simulate
from rtid.sim.simulated_plant import EDGES, SimulatedPlant, smooth_plant


@pytest.fixture(scope="module")
def sweep() -> Run:
    return simulate(SimulatedPlant(), "sweep", seed=7)


def test_samples_are_complete(sweep: Run) -> None:
    samples = sweep.samples
    assert samples.names == NAMES
    assert len(samples) == 80_000
    assert samples.t_us[0] == 0 and (np.diff(samples.t_us) == 1000).all()
    assert samples.flags[0] == ROW | GAP and (samples.flags[1:] == ROW).all()
    assert np.isfinite(samples.values).all()


def test_same_seed_same_samples_other_seed_other_samples() -> None:
    first, again, other = (
        simulate(draw(2), "rich", seed=seed, duration_s=2.0).samples for seed in (4, 4, 5)
    )
    assert first.values.tobytes() == again.values.tobytes()
    assert first.values.tobytes() != other.values.tobytes()


def test_the_swept_sine_is_tracked(sweep: Run) -> None:
    s = sweep.truth.signals
    assert np.std(s[:, 5] - sweep.truth.x_ref_m) < 2e-3
    assert np.ptp(s[:, 5]) == pytest.approx(0.13, abs=0.01)
    assert s[:, 1:3].min() > 0.1e6 and s[:, 1:3].max() < 8e6
    assert 4 < np.abs(s[:, 0]).max() < 10


@pytest.mark.parametrize("motion", ["sweep", "rich", "moves"])
def test_random_plants_stay_sane(motion: str) -> None:
    for seed in range(6):  # simulate() itself raises on cavitation and the stroke's end
        run = simulate(draw(seed), motion, seed=seed, duration_s=10.0)
        assert np.abs(run.truth.signals[:, 5] - run.truth.x_ref_m).max() < 0.03


def test_sensor_noise_and_counts(sweep: Run) -> None:
    error = sweep.samples.values - sweep.truth.signals
    sensors = Sensors()
    rms = np.sqrt(sensors.noise() ** 2 + sensors.resolution() ** 2 / 12)
    assert np.std(error[:, 1:], axis=0) == pytest.approx(rms[1:], rel=0.02)
    assert np.abs(error[:, 1:].mean(axis=0) / rms[1:]).max() < 0.02
    assert not error[:, 0].any()  # the command is what was commanded
    counts = sweep.samples.values / sensors.resolution()
    assert np.allclose(counts, np.round(counts), rtol=0, atol=1e-6)


def test_exact_sensors_show_the_truth() -> None:
    run = simulate(smooth_plant(), "rich", duration_s=1.0, sensors=EXACT)
    assert np.array_equal(run.samples.values, run.truth.signals)


def test_declaration_is_honest(sweep: Run) -> None:
    for plant in (SimulatedPlant(), draw(1), draw(9, cross_port=True)):
        model = declared_model(plant, seed=1)
        assert tuple(s.name for s in model.signals) == NAMES
        assert tuple(edge.name for edge in model.edges) == plant.edges
        assert 0.7 <= model.beta_nominal_pa / plant.beta_pa <= 1.3
        assert abs(model.lag.nominal_s - plant.lag_s) <= model.lag.tolerance_s
        c = plant.constants
        full = model.chambers[1].v0_m3 - c.area_b_m2 * c.stroke_m
        assert full == pytest.approx(c.v0_b_m3)


def test_declared_grid_covers_the_run(sweep: Run) -> None:
    model = declared_model(sweep.plant)
    for edge in model.edges:
        dp = sweep.samples.column(edge.source) - sweep.samples.column(edge.sink)
        w = edge.direction * sweep.samples.column("u")
        open_dp = dp[w > edge.safe_band_v]
        assert edge.grid.dp_pa[0] < open_dp.min() and open_dp.max() < edge.grid.dp_pa[-1]
        assert edge.grid.u_v[0] <= edge.safe_band_v and w.max() < edge.grid.u_v[-1]
        assert (np.diff(edge.grid.u_v) > 0).all() and (np.diff(edge.grid.dp_pa) > 0).all()


def test_declared_ranges_hold_the_sensors(sweep: Run) -> None:
    model = declared_model(sweep.plant)
    for signal, values in zip(model.signals, sweep.samples.values.T, strict=True):
        assert signal.minimum <= values.min() and values.max() <= signal.maximum


def test_a_smooth_plant_is_declared_open_from_zero() -> None:
    grid = uniform_grid((0.0, 10.0, 20), (0.0, 8e6, 16))
    model = declared_model(smooth_plant(), grid=dict.fromkeys(EDGES, grid))
    assert {edge.safe_band_v for edge in model.edges} == {0.0}
    assert model.edges[0].grid.shape == (20, 16)


def test_a_long_rich_run_stays_sane() -> None:
    """80 s of everything at once, on the default machine and on some that once oscillated."""
    for plant in (SimulatedPlant(), draw(35), draw(43)):
        p = simulate(plant, "rich", seed=35).truth.signals[:, 1:3]
        assert p.min() > 0.1e6 and p.max() < 9e6
