"""What `rtid quick` makes of a record: sizes, spans, grids, and which verdict it keeps."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware_bridge.samples import ROW, Samples
from rtid.project import load
from rtid.project.guess import RoleCandidate
from rtid.study import quick_machine
from rtid.study.quick_command import is_taken
from rtid.study.quick_machine import (
    MOST_S,
    Given,
    dp_grid,
    first_machine,
    fitted_machine,
    rated_flow,
)
from rtid.study.quick_project import project_text
from rtid.trace.quick_source import Source, open_source, roles_of
from tests.test_quick import as_csv


@pytest.mark.parametrize(
    ("held", "line", "is_better"),
    [
        (("unknown", 0, 9.0), ("insufficient_data", 0, 4.0), True),
        (("missing", 1, 1.3), ("matches", 0, 1.0), True),
        (("missing", 2, 1.3), ("ambiguous", 1, 1.0), True),
        (("ambiguous", 1, 1.3), ("insufficient_data", 0, 1.2), False),
        (("missing", 1, 1.0), ("missing", 2, 0.9), False),
    ],
)
def test_what_was_named_is_not_given_up_for_less(held: Any, line: Any, is_better: bool) -> None:
    def said(verdict: str, n: int, rho: float) -> Any:
        return SimpleNamespace(verdict=verdict, found=n * [None], rho_after=rho)

    assert is_taken(said(*line), said(*held)) == is_better


def test_a_safe_band_is_in_the_unit_of_the_command() -> None:
    ends = {"x": ("m", 0.0, 0.5), "p_a": ("Pa", 0.0, 7e6), "p_b": ("Pa", 0.0, 7e6)}
    ends["u"] = ("mA", -400.0, 400.0)
    roles = {role: RoleCandidate(role, "", *known) for role, known in ends.items()}
    assert first_machine(roles, Given(safe_band=50.0)).safe_band == pytest.approx(0.05)
    assert first_machine(roles, Given()).safe_band is None
    t = np.linspace(0.0, 60.0, 6001)
    u, x = 0.4 * np.sin(t), 0.25 - 0.2 * np.cos(t)
    values = np.column_stack([u, x, 3e6 + 1e5 * u, 3e6 - 1e5 * u, 0 * t + 7e6, 0 * t + 1e5])
    names = ("u", "x", "p_a", "p_b", "p_supply", "p_tank")
    samples = Samples(names, (t * 1e6).astype(np.int64), values, np.full(len(t), ROW, np.uint8))
    machine = fitted_machine(first_machine(roles, Given()), samples)
    (said,) = (a.what for a in machine.assumptions if "--safe-band" in a.what)
    assert f"|u| = {1e3 * (machine.safe_band or 0.0):.3g} mA," in said


def test_the_noise_of_a_command_is_written_in_its_unit() -> None:
    """What is unknown of it between its samples; the position has its own unit as well."""
    ends = {"x": ("mm", 0.0, 500.0), "p_a": ("bar", 0.0, 70.0), "p_b": ("bar", 0.0, 70.0)}
    ends["u"] = ("mA", -400.0, 400.0)
    roles = {role: RoleCandidate(role, "", *known) for role, known in ends.items()}
    first = first_machine(roles, Given())
    machine = replace(first, command_hold="linear", command_noise=0.003, noise_seen={"x": 1e-5})
    source = Source({"kind": "table"}, list(roles.values()), {}, {})
    signals = tomllib.loads(project_text("m", source, roles, machine))["signals"]
    assert (signals["u"]["noise"], signals["u"]["unit"]) == (pytest.approx(3.0), "mA")
    assert signals["x"]["noise_seen"] == pytest.approx(0.01)


def test_a_stamp_years_ahead_costs_no_memory() -> None:
    t_us = np.append(np.arange(0, 300_000_000, 100_000), 2**52).astype(np.int64)
    x = np.sin(1e-7 * t_us)
    samples = Samples(("x",), t_us, x[:, None], np.full(len(x), ROW, np.uint8))
    span = quick_machine._span(samples, x)
    assert span is not None and span[1] - span[0] == quick_machine.MOST_S


@pytest.mark.parametrize("rate_hz", [0.9, 1.0, 2.0])
def test_a_motion_that_a_look_each_second_misses_is_motion(rate_hz: float) -> None:
    """One of 1 Hz was a standstill, and the rest before it was looked at."""
    t_us = np.arange(0, 600_000_000, 5_000)
    t_s = 1e-6 * t_us
    x = np.where((t_s > 400.0) & (t_s < 520.0), 0.05 * np.sin(2 * np.pi * rate_hz * t_s), 0.0)
    x += 1e-5 * np.random.default_rng(0).standard_normal(len(x))
    samples = Samples(("x",), t_us, x[:, None], np.full(len(x), ROW, np.uint8))
    assert quick_machine._span(samples, x) == pytest.approx((400.0, 520.0), abs=1.0)


@pytest.mark.parametrize("power", [0.5, 1.0, 1.6])
def test_the_rated_flow_is_that_of_a_valve_that_opens_on_as_it_did(power: float) -> None:
    """A straight line from neutral took a valve of 16.5 L/min for one of 11.2."""
    u = np.linspace(-7.0, 7.0, 1401)
    supply, tank, chamber = np.full(1401, 7e6), np.full(1401, 1e5), np.full(1401, 3.55e6)
    dp = np.where(u > 0.0, supply - chamber, chamber - tank)
    area = math.pi / 4 * 0.05**2
    speed = 1e-7 * np.maximum(np.abs(u) - 1.0, 0.0) ** power * np.sqrt(dp) / area
    columns = {"u": u, "p_supply": supply, "p_tank": tank, "p_a": chamber, "p_b": chamber}
    machine: Any = SimpleNamespace(u_grid=np.array([0.0, 10.0]), bore_m=0.05, rod_m=0.0)
    samples: Any = SimpleNamespace(column=columns.__getitem__)
    wanted = 1e-7 * 9.0**power * np.sqrt(5e5)
    assert rated_flow(machine, samples, speed, 1.0) == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize(("low", "high"), [(0.0, 6e6), (-3e4, 6e6), (-4e6, 6e6), (2e5, 2e5)])
def test_the_grid_of_dp_holds_the_data(low: float, high: float) -> None:
    borders = dp_grid(low, high)
    assert borders[0] <= low and borders[-1] >= high
    assert (np.diff(borders) > 0).all()


def test_a_long_record_is_cut_to_where_it_moves(tmp_path: Path) -> None:
    t = np.arange(0.0, 1000.0, 0.1)
    x = 0.2 + 0.1 * np.sin(t) * ((t > 500) & (t < 620))
    u = 5.0 * np.sin(t)
    path = as_csv(tmp_path / "t.csv", t=t, u=u, x=x, p_a=3e6 + 1e5 * u, p_b=3e6 - 1e5 * u)
    source = open_source(path, None)
    roles = roles_of(path, source)
    first = first_machine(roles, Given())
    values = np.column_stack([u, x, 3e6 + 1e5 * u, 3e6 - 1e5 * u, 0 * t + 7e6, 0 * t + 1e5])
    names = ("u", "x", "p_a", "p_b", "p_supply", "p_tank")
    samples = Samples(names, (t * 1e6).astype(np.int64), values, np.full(len(t), ROW, np.uint8))
    machine = fitted_machine(first, samples)
    (begin, _), (_, end) = machine.spans_s
    assert (begin, end) == pytest.approx((500.0, 500.0 + MOST_S), abs=3.0)
    file = tmp_path / "m.toml"
    file.write_text(project_text("m", source, roles, machine))
    record = load(file).sections.record
    assert record.identification_s is not None and record.validation_s is not None
    assert record.validation_s[1] - record.identification_s[0] == pytest.approx(MOST_S)
    assert "120 s with the most motion" in " ".join(a.what for a in machine.assumptions)


def test_a_position_below_zero_is_moved(tmp_path: Path) -> None:
    roles = {
        "u": RoleCandidate("u", "", "V", -8.0, 8.0),
        "x": RoleCandidate("x", "", "mm", -250.0, 240.0),
        "p_a": RoleCandidate("a", "", "bar", 1.0, 90.0),
        "p_b": RoleCandidate("b", "", "bar", 1.0, 90.0),
    }
    machine = first_machine(roles, Given())
    assert machine.x_zero_m == pytest.approx(-0.25)
    assert machine.stroke_m == pytest.approx(0.5)
    assert any("fully retracted at x = -250 mm" in a.what for a in machine.assumptions)
