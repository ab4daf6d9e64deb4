"""Hidden effects between command and spool and in the sensors have the times that are stated."""

import numpy as np
import pytest

from rtid.plain import FloatArray
from rtid.sim import closed_loop, spool
from rtid.sim.hidden import HIDDEN, hide
from rtid.sim.run import EXACT, Run, simulate
from rtid.sim.simulated_plant import EDGES, Controller, SimulatedPlant

AT_MS, SIZE_V = 100, 3.0


def one_step(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """Reference held, command steps by SIZE_V at AT_MS."""
    drive = np.zeros((round(duration_s * 1e3) + 1, 6))
    drive[:, closed_loop.X_REF], drive[:, closed_loop.P_SUPPLY] = 0.25, 7e6
    drive[:, closed_loop.P_TANK], drive[AT_MS:, closed_loop.DITHER] = 1e5, SIZE_V
    return drive


def opening(name: str, strength: float, edge: str = "pb", lag_s: float = 1.3e-3) -> FloatArray:
    """Opening of an edge, signed as the command, after one step of it, V."""
    plant = SimulatedPlant(controller=Controller(kp_1ps=0.0, deadband_v=0.0), lag_s=lag_s)
    run = simulate(hide(plant, name, strength), one_step, 0, 0.4, EXACT)
    column = EDGES.index(edge)
    return run.truth.opening_v[:, column] * plant.directions[column]


def rich(name: str, level: str, duration_s: float = 4.0) -> Run:
    plant = hide(SimulatedPlant(), name, HIDDEN[name].strength(level))
    return simulate(plant, "rich", 2, duration_s, EXACT)


@pytest.mark.parametrize("delay_s", [3e-3, 0.4e-3, 7.25e-3])
def test_delay_shifts_exactly(delay_s: float) -> None:
    """Also between samples: the spool's exponential begins at the delayed instant."""
    t = np.arange(400) * 1e-3 - AT_MS * 1e-3 - delay_s
    expected = np.where(t > 0, SIZE_V * -np.expm1(-np.maximum(t, 0) / 1.3e-3), 0.0)
    assert opening("input_delay", delay_s) == pytest.approx(expected, abs=1e-12)


def test_delay_without_lag_shows_the_former_command() -> None:
    w = opening("input_delay", 2.5e-3, lag_s=0.0)
    assert not w[: AT_MS + 3].any() and (w[AT_MS + 3 :] == SIZE_V).all()


def test_second_order_step_response() -> None:
    """Natural frequency 65 rad/s, damping 0.9: the textbook's response, in place of the lag."""
    wn, zeta = 65.0, 0.9
    t = np.maximum(np.arange(400) * 1e-3 - AT_MS * 1e-3, 0)
    wd = wn * np.sqrt(1 - zeta**2)
    swing = np.cos(wd * t) + zeta * wn / wd * np.sin(wd * t)
    expected = SIZE_V * (1 - np.exp(-zeta * wn * t) * swing)
    assert opening("spool_lag_second_order", wn) == pytest.approx(expected, abs=1e-12)
    slow, fast = (opening("spool_lag_second_order", wn, edge) for edge in ("pa", "at"))
    assert (slow[AT_MS + 1 : AT_MS + 40] < fast[AT_MS + 1 : AT_MS + 40]).all()


def test_an_additional_lag_is_a_second_one_behind_the_first() -> None:
    t = np.maximum(np.arange(400) * 1e-3 - AT_MS * 1e-3, 0)
    a, b = 1.3e-3, 5e-3
    expected = SIZE_V * (1 - (a * np.exp(-t / a) - b * np.exp(-t / b)) / (a - b))
    assert opening("spool_lag_first_order", b) == pytest.approx(expected, abs=1e-12)
    alone = SIZE_V * -np.expm1(-t / b)
    assert opening("spool_lag_first_order", b, lag_s=0.0) == pytest.approx(alone, abs=1e-12)


@pytest.mark.parametrize("lag_s", [0.0, 1.3e-3, 10e-3])
def test_a_limit_takes_a_step_in_a_straight_line_and_then_as_its_lag(lag_s: float) -> None:
    rate, edge = 60.0, "pb"  # whose spools are as fast as is stated
    t = np.maximum(np.arange(400) * 1e-3 - AT_MS * 1e-3, 0)
    near = rate * lag_s
    bend = (SIZE_V - near) / rate
    fading = near * np.exp(-np.maximum(t - bend, 0.0) / max(lag_s, 1e-9))
    expected = np.where(t < bend, rate * t, SIZE_V - fading)
    assert opening("spool_rate_limit", rate, edge, lag_s) == pytest.approx(expected, abs=1e-9)
    slow, fast = (opening("spool_rate_limit", rate, e, lag_s) for e in ("pa", "at"))
    assert slow[AT_MS + 20] == pytest.approx(0.98 * fast[AT_MS + 20], rel=1e-3)


@pytest.mark.parametrize("damping", [0.2, 1.0 - 1e-12, 1.0, 3.0])
def test_propagator_is_the_exponential_of_its_matrix(damping: float) -> None:
    from scipy.linalg import expm

    wn, h, p = 200.0, 3e-3, np.empty(4)
    matrix = np.array([[0.0, 1.0], [-wn * wn, -2 * damping * wn]])
    for kernel in (spool.propagator, spool.propagator.py_func):
        kernel(wn, damping, h, p)
        assert p.reshape(2, 2) == pytest.approx(expm(matrix * h), rel=1e-6, abs=1e-9)


def test_play_has_its_full_width_and_round_corners() -> None:
    """A slow triangle: rising and falling branch are one width apart; corners are spread."""
    u = np.concatenate(
        [np.linspace(0, 2, 2001), np.linspace(2, -2, 4001), np.linspace(-2, 0, 2001)]
    )
    for kernel in (spool.play, spool.play.py_func):
        plays = np.zeros(spool.PLAYS)
        w = np.array([kernel(v, 0.3, plays) for v in u])
        falling, rising = w[3500:4500], w[6500:7500]
        assert u[3500:4500] - falling == pytest.approx(-0.15)
        assert u[6500:7500] - rising == pytest.approx(0.15)
        turn = np.diff(w[2002:2452]) / np.diff(u[2002:2452])
        assert turn[0] == 0 and (turn[250:300] > 0).all() and (turn[250:300] < 1).all()
        assert turn[-1] == pytest.approx(1)


def test_a_sticking_pilot_rests_and_catches_up() -> None:
    u = np.concatenate([np.zeros(200), np.linspace(0, 1, 1000), np.linspace(1, 5, 100)])
    for kernel in (spool.sticking_pilot, spool.sticking_pilot.py_func):
        pilot = np.array([0.0, 0.0, 1.0])
        w = np.array([kernel(v, 0.15, pilot) for v in u])
        slow, off = slice(400, 1200), np.abs(u - w)
        assert off.max() <= 0.15
        assert (np.diff(w)[slow] == 0).mean() > 0.5  # it rests most of the time
        assert not off[-50:].any()  # and follows what is fast


def test_position_sensor_is_late_for_the_controller_too() -> None:
    run = rich("position_sensor_delay", "strong")
    x, seen = run.truth.signals[:, 5], run.samples.column("x")
    assert seen[5:] == pytest.approx(x[:-5], abs=1e-12)
    assert (seen[:5] == x[0]).all()
    half = simulate(hide(SimulatedPlant(), "position_sensor_delay", 1.5e-3), "rich", 2, 1.0, EXACT)
    x, seen = half.truth.signals[:, 5], half.samples.column("x")
    assert seen[2:] == pytest.approx(0.5 * (x[1:-1] + x[:-2]), abs=1e-12)
    k, drive_u = SimulatedPlant().controller, half.truth.signals[:, 0]
    assert k.kp_1ps > 0 and drive_u.any()


def test_pressure_sensor_lag_delays_slow_pressures_by_its_time() -> None:
    run = rich("pressure_sensor_lag", "strong", 10.0)
    for name, column in (("p_a", 1), ("p_b", 2)):
        p, seen = run.truth.signals[:, column], run.samples.column(name)
        kernel = np.hanning(401) / np.hanning(401).sum()
        slow, slow_seen = (np.convolve(v, kernel, "valid") for v in (p, seen))
        behind = np.linalg.lstsq(np.gradient(slow, 1e-3)[:, None], slow - slow_seen, rcond=None)[0]
        assert behind[0] == pytest.approx(5e-3, rel=0.02)


def test_bias_and_scale_are_in_their_column_alone() -> None:
    run = rich("pressure_sensor_bias", "middle")
    off = run.samples.values - run.truth.signals
    assert off[:, 1] == pytest.approx(0.3e6) and not off[:, [0, 2, 3, 4, 5, 6]].any()
    run = rich("velocity_scale", "middle")
    assert run.samples.column("v") == pytest.approx(1.06 * run.truth.signals[:, 6])


def test_line_sensors_sit_where_they_are_told() -> None:
    at_cylinder = rich("line_dynamics", "middle")
    at_valve = rich("line_dynamics_seen_at_valve", "middle")
    assert np.array_equal(at_valve.truth.signals, at_cylinder.truth.signals)
    assert np.array_equal(at_valve.samples.values[:, [1, 2]], at_valve.truth.ports_pa)
    assert np.array_equal(at_cylinder.samples.values, at_cylinder.truth.signals)


def test_wider_dead_bands_are_true_of_the_map() -> None:
    plant = hide(SimulatedPlant(), "deadband_shift", 0.15)
    pairs = zip(plant.valves, SimulatedPlant().valves, strict=True)
    added = [new.deadband_v - old.deadband_v for new, old in pairs]
    assert added == pytest.approx([0.15, 0.165, 0.135, 0.1575, 0.1425])
    assert plant.flow("pa", 1.95, 1e6) < 0.5 * SimulatedPlant().flow("pa", 1.95, 1e6)
