"""Rests against the stops: within the limits, and what `rtid diagnose` then tells of the zeros."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtid.diagnose.joined import joints
from rtid.diagnose.standing import fitted, with_bank
from rtid.diagnose.trials import scored
from rtid.diagnose.zeros import zeros
from rtid.excite.design import CandidateSegment, Design
from rtid.excite.excitable import limits_of, machine_of, section_of
from rtid.excite.information import of_blocks
from rtid.excite.library import library
from rtid.excite.machine import DrivenMachine
from rtid.excite.motion_limits import LimitError, Limits
from rtid.excite.stops import REST_AT_STOP_S, against_stops, with_rests
from rtid.plain import FloatArray
from rtid.project import load
from tests.excite.machines import machine, write_project

NUMBER, SEGMENTS = 1, 4


def asked(folder: Path, **more: object) -> tuple[DrivenMachine, Limits]:
    """The nominal machine and its limits; more: lines of [excite]."""
    project = load(write_project(folder, machine(NUMBER), NUMBER, **more))  # type: ignore[arg-type]
    return machine_of(project, section_of(project)), limits_of(section_of(project))


def with_stops(folder: Path) -> tuple[DrivenMachine, Limits]:
    plant = machine(NUMBER)
    pressure = [0.05, 1.05e-6 * plant.p_supply_pa]
    return asked(folder, stops_m=[0.0, plant.constants.stroke_m], pressure_mpa=pressure)


def some_motion(nominal: DrivenMachine, limits: Limits) -> Design:
    """A few segments of the library, as a design."""
    parts = [s for s in library(limits) if s.name.startswith("pass")][::12][:SEGMENTS]
    told = [CandidateSegment(s, of_blocks(nominal, nominal.run(s.reference))) for s in parts]
    nothing = np.zeros(0)
    return Design(nominal, limits, tuple(told), nothing, nothing, (), nothing)


def at_rest(design: Design) -> FloatArray:
    """What is expected (n, 2 + signals), and no flow, so no drop, where the piston stands.

    A map of blocks knows no corner at dp = 0: the nominal machine shows 70 kPa there.
    """
    chunk, of = design.expected.copy(), design.machine
    column = {s.name: 2 + k for k, s in enumerate(of.model.signals)}
    u, x = (of.signal(chunk, k) for k in (of.places.u, of.places.x))
    ends = design.limits.stroke_m
    for stop, fed, drained in ((ends[1], "p_a", "p_b"), (ends[0], "p_b", "p_a")):
        held = (np.abs(x - stop) < 1e-3) & (np.abs(u) > 4.0)
        assert np.count_nonzero(held) > 2500
        chunk[held, column[fed]] = chunk[held, column["p_supply"]]
        chunk[held, column[drained]] = chunk[held, column["p_tank"]]
    return chunk


@pytest.mark.long
def test_rests_tell_the_zeros_of_all_pressure_sensors(tmp_path: Path) -> None:
    nominal, limits = with_stops(tmp_path)
    rests = against_stops(limits, nominal)
    assert rests.duration_s < 25.0
    design = with_rests(some_motion(nominal, limits), rests, limits)
    assert all(e.is_kept for e in design.extremes)
    chunk = design.machine.measured(at_rest(design), 5)
    chunk[:, 2 + nominal.model.column("p_b")] += 0.1e6
    fit = fitted(nominal.model, chunk)
    told = {z.signal: z for z in zeros(fit, joints(fit, chunk, scored(with_bank(fit))))}
    assert told.keys() == {"p_supply", "p_a", "p_b"}
    assert all(z.is_confirmed and z.seconds > REST_AT_STOP_S for z in told.values())
    assert told["p_b"].is_off
    assert not told["p_a"].is_off
    assert abs(told["p_b"].apart_pa - 0.1e6) < 3.0 * told["p_b"].std_pa < 30e3


def test_no_stop_is_touched_that_is_not_given(tmp_path: Path) -> None:
    nominal, limits = asked(tmp_path)
    with pytest.raises(LimitError, match="stops"):
        against_stops(limits, nominal)


def test_a_supply_above_the_chambers_limit_is_refused(tmp_path: Path) -> None:
    stops = [0.0, machine(NUMBER).constants.stroke_m]
    nominal, limits = asked(tmp_path, stops_m=stops, pressure_mpa=[0.1, 5.0])
    with pytest.raises(LimitError, match="pressure"):
        against_stops(limits, nominal)
