"""Zeros of pressure sensors: told where an open valve joins them at rest, and only there."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from rtid.diagnose.diagnosis import Result, search
from rtid.diagnose.joined import joints, opening
from rtid.diagnose.summary import diagnosis
from rtid.diagnose.trials import scored
from rtid.diagnose.zeros import Zero, zeros
from rtid.kernels.engine import GAP_FLAG
from rtid.model import PRESSURE, Machine
from rtid.plain import FloatArray
from rtid.sim.random_plants import draw
from rtid.tell.diagnosed import sentences
from rtid.units import Z95
from tests.diagnose.records import record
from tests.diagnose.stops import against_the_stops

BOTH_STOPS = ((9.0, 3.0), (-9.0, 3.0))
LEAK = "internal_leakage_laminar"


def with_stops(
    chunk: FloatArray,
    seed: int,
    commands: tuple[tuple[float, float], ...] = BOTH_STOPS,
    leak: float = 0.0,
) -> FloatArray:
    """A record, chunk (n, 2 + signals), and behind it the machine against its stops."""
    values = against_the_stops(draw(seed), commands, seed, leak)
    more = np.column_stack(
        [chunk[-1, 0] + 5.0 + 1e-3 * np.arange(len(values)), np.ones(len(values)), values]
    )
    more[0, 1] = int(more[0, 1]) | GAP_FLAG
    return np.vstack([chunk, more])


def shifted(model: Machine, chunk: FloatArray, by: dict[str, float]) -> FloatArray:
    """The record, chunk (n, 2 + signals), as sensors with these zeros, Pa, show it."""
    chunk = chunk.copy()
    for name, bias in by.items():
        chunk[:, 2 + model.column(name)] += bias
    return chunk


@cache
def learned(effect: str = "", strength: float = 0.0, seed: int = 3) -> Result:
    return search(*record(effect, strength, seed))


def told(result: Result, chunk: FloatArray) -> dict[str, Zero]:
    """What a record, chunk (n, 2 + signals), tells beside the maps of a fit."""
    found = joints(result.last, chunk, scored(result.last))
    return {zero.signal: zero for zero in zeros(result.last, found)}


@pytest.mark.first_of(1)
@pytest.mark.parametrize(("seed", "signal", "bias"), [(3, "p_b", 0.1e6), (4, "p_a", -0.25e6)])
def test_a_zero_that_is_off_is_named_with_its_size(seed: int, signal: str, bias: float) -> None:
    model, chunk, held_out = record(seed=seed)
    first, last = (
        shifted(model, part, {signal: bias}) for part in (chunk, with_stops(held_out, seed))
    )
    said = diagnosis(search(model, first, last))
    assert said.verdict == "missing"
    (effect,) = said.found
    assert (effect.effect, effect.where) == ("pressure_sensor_bias", signal)
    size = effect.parameters["bias"]
    assert abs(size.value - bias) < 3 * size.std < 5e3
    assert effect.hidden_in_map is not None
    assert max(effect.hidden_in_map.maps.values()) > 0.01
    assert any("Pressure sensor bias" in line for line in sentences(said))


def test_what_a_zero_bends_is_what_it_moves_the_true_map_by() -> None:
    model, chunk, _ = record(seed=3)
    off = told(learned(), shifted(model, with_stops(chunk, 3), {"p_b": 50e3}))["p_b"]
    plant, view = draw(3), learned().last.view
    for edge, direction, sign in (("pb", -1, -1.0), ("bt", 1, 1.0)):
        i = [e.name for e in model.edges].index(edge)
        at = view.inside & (view.flow(i) != 0.0)
        u, p = view.signal("u")[:-1][at], view.signal("p_b")[:-1][at]
        dp = (
            view.signal("p_supply")[:-1][at] - p
            if edge == "pb"
            else p - view.signal("p_tank")[:-1][at]
        )
        true, moved = (plant.flow(edge, direction * u, dp + by) for by in (0.0, sign * 50e3))
        bend = np.sqrt(np.mean((moved - true) ** 2)) / np.abs(true).max()
        assert off.maps[edge] == pytest.approx(bend, rel=0.25)


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4])
def test_sensors_that_agree_are_said_to(seed: int) -> None:
    model, chunk, held_out = record(seed=seed)
    said = diagnosis(search(model, chunk, with_stops(held_out, seed)))
    assert (said.verdict, said.found) == ("matches", ())
    assert [zero.signal for zero in said.zeros] == ["p_supply", "p_a", "p_b"] or len(
        said.zeros
    ) == 3
    assert any("agree within" in line for line in sentences(said))
    limits = {u.where: u for u in said.not_found if u.effect == "pressure_sensor_bias"}
    assert limits.keys() == {"p_a", "p_b", "p_supply"}
    assert all(u.visible and 0.0 < (u.detection_limit or 0.0) < 20e3 for u in limits.values())


@pytest.mark.long
def test_a_zero_that_bends_no_map_is_told_and_not_named() -> None:
    model, chunk, held_out = record(seed=3)
    first, last = (
        shifted(model, part, {"p_a": -20e3}) for part in (chunk, with_stops(held_out, 3))
    )
    said = diagnosis(search(model, first, last))
    assert (said.verdict, said.found) == ("matches", ())
    assert any(
        "p_a shows 0.0200" in line and "less than p_tank" in line for line in sentences(said)
    )


def test_a_record_that_never_rests_with_an_open_valve_tells_nothing() -> None:
    said = diagnosis(learned())
    assert said.zeros == ()
    unseen = next(u for u in said.not_found if u.effect == "pressure_sensor_bias")
    assert not unseen.visible


@pytest.mark.long
@pytest.mark.parametrize("strength", [6e-13, 2e-12])
def test_a_leak_that_a_valve_feeds_at_rest_is_in_the_interval(strength: float) -> None:
    """Its drop over the open valve passes for a zero otherwise: up to 0.1 MPa here."""
    result = learned(LEAK, strength, 3)
    _, chunk, _ = record(seed=3)
    for zero in told(result, with_stops(chunk, 3, leak=strength)).values():
        assert abs(zero.apart_pa) < Z95 * zero.std_pa
        assert not zero.matters


def rounded(
    model: Machine, chunk: FloatArray, noise: float, step: float
) -> tuple[Machine, FloatArray]:
    """The machine and its record, whose pressures at rest have white noise and steps, Pa."""
    chunk, rng = chunk.copy(), np.random.default_rng(0)
    stop = chunk[:, 0] > chunk[np.argmax(np.diff(chunk[:, 0])), 0]
    names = [s.name for s in model.signals if s.kind == PRESSURE]
    for column in (2 + model.column(name) for name in names):
        level = uniform_filter1d(chunk[stop, column], 201)
        level += noise * rng.standard_normal(len(level))
        chunk[stop, column] = np.round(level / step) * step
    coarse = [replace(s, noise=noise, resolution=step) for s in model.signals]
    signals = [
        new if new.name in names else s for new, s in zip(coarse, model.signals, strict=True)
    ]
    return replace(model, signals=tuple(signals)), chunk


@pytest.mark.parametrize(("noise", "most"), [(100.0, 5e3), (3e3, 400.0)])
def test_no_mean_is_better_than_a_step_without_noise(noise: float, most: float) -> None:
    """2.5 kPa in steps of 6.1 kPa were 6104 +- 19 Pa; where noise dithers them they go."""
    model, chunk, _ = record(seed=3)
    off = shifted(model, with_stops(chunk, 3), {"p_b": 2.5e3})
    model, off = rounded(model, off, noise, 25e6 / 4096)
    result = learned()
    coarse = replace(result, last=replace(result.last, declared=model))
    zero = told(coarse, off)["p_b"]
    assert abs(zero.apart_pa - 2.5e3) < Z95 * zero.std_pa < most


def test_one_stop_alone_does_not_say_which_sensor_is_off() -> None:
    model, chunk, _ = record(seed=3)
    off = told(learned(), shifted(model, with_stops(chunk, 3, ((9.0, 3.0),)), {"p_a": 0.2e6}))
    assert off["p_a"].against == "p_supply"
    assert off["p_a"].is_off
    assert not off["p_a"].matters


def test_what_only_one_way_shows_is_no_zero() -> None:
    """A check valve before a chamber holds it above the supply, with the valve open."""
    model, chunk, _ = record(seed=3)
    held = with_stops(chunk, 3)
    behind = held[:, 2 + model.column("u")] > 8.0
    held[behind, 2 + model.column("p_a")] += 0.3e6
    assert not any(zero.matters for zero in told(learned(), held).values())


def test_a_piston_that_creeps_is_not_at_rest() -> None:
    model, chunk, _ = record(seed=3)
    moving = with_stops(chunk, 3)
    stop = moving[:, 0] > chunk[-1, 0]
    moving[stop, 2 + model.column("x")] += 1e-3 * (moving[stop, 0] - moving[stop, 0][0])
    assert told(learned(), moving) == {}


def test_a_gap_ends_a_rest() -> None:
    _, chunk, _ = record(seed=3)
    torn = with_stops(chunk, 3)
    stop = np.flatnonzero(torn[:, 0] > chunk[-1, 0])
    torn[stop[::200], 1] = GAP_FLAG + 1
    assert told(learned(), torn) == {}


@pytest.mark.parametrize(
    ("gains", "opens_v"),
    [
        ([0.0, 1.0, 5.0, 6.0], 2.0),
        ([np.nan, 0.1, 5.0, np.nan], 2.0),
        ([5.0, 6.0, np.nan, 0.1], np.inf),  # a rig's run: little was known of the last block
        ([np.nan] * 4, np.inf),
        ([0.0] * 4, np.inf),
    ],
)
def test_a_valve_opens_where_all_that_is_known_further_on_is_open(
    gains: list[float], opens_v: float
) -> None:
    assert opening(np.array(gains), np.arange(5.0)) == opens_v


def test_a_valve_that_is_shut_joins_nothing() -> None:
    """What its map makes of blocks that it hardly knows, below the dead band, opens no valve."""
    _, chunk, _ = record(seed=3)
    still = with_stops(chunk, 3, ((1.2, 3.0), (-1.2, 3.0)))
    assert told(learned(), still) == {}


@pytest.mark.long
def test_a_finding_that_needs_the_flow_of_the_map_is_among_the_leaks() -> None:
    """A lag of the spools beside a rest: the leaks' columns ask for the fitted map."""
    _, chunk, _ = record(seed=3)
    result = search(*record("input_delay", 15e-3, 3))
    assert {zero.signal for zero in told(result, with_stops(chunk, 3)).values()} == {
        "p_a",
        "p_b",
        "p_supply",
    }
