"""Seconds of rest against each stop with the valves open: there the pressure sensors' zeros show.

    home -> slowly to the stop -> the reference goes on until the command is HELD -> rest -> back

One chamber is then joined to the supply and the other one to the tank, the other way round at the
other stop: four joints for three zeros (`rtid.diagnose.joined`).  Only where the stops are given.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rtid.excite.design import CandidateSegment, Design, checked, stitched
from rtid.excite.driving import STEP_S, SUPPLY, V_REF, X_REF
from rtid.excite.information import of_blocks
from rtid.excite.library import REST_S, Segment, home_m
from rtid.excite.machine import DrivenMachine
from rtid.excite.motion_limits import LimitError, Limits, require_kept
from rtid.plain import FloatArray

NAME = "against both stops, valves open"
HELD = 0.6  # of the largest command: clearly open
PACE, CREEP = 0.5, 0.06  # of the highest speed: on the way, and for the last part of it
LAST = 0.05  # of the way
PRESS_S, REST_AT_STOP_S, CALM_S = 0.6, 3.0, 0.6  # until the command is held; held; off the stop
NEAR_PA = 0.1e6
EASE_S = 0.6  # no speed jumps: behind a stop the chambers are far from balance


def against_stops(limits: Limits, machine: DrivenMachine) -> Segment:
    """The rests; LimitError where the stops are not given, or the supply cannot be there."""
    if limits.stops_m is None:
        raise LimitError(
            "the zeros of pressure sensors show where the piston rests against its stops",
            "stops_mm = [0, 500] in [excite], if it may be held there",
        )
    supply = float(np.clip(machine.supply_pa, *limits.supply_pa))
    if supply > limits.pressure_pa[1]:
        raise LimitError(
            f"against a stop a chamber has the supply's pressure, {supply:.4g} Pa",
            "a lower supply, or a higher pressure_mpa in [excite]",
        )
    home, control = home_m(limits), machine.control
    past = (HELD * control.limit_v - control.deadband_v) / control.volts_per_mps / control.kp_1ps
    moved, pressed = [np.zeros(round(REST_S / STEP_S))], [np.zeros(round(REST_S / STEP_S))]
    for stop in limits.stops_m:
        for v, beyond in _there_and_back(stop - home, max(past, 0.0), limits.speed_mps):
            moved.append(v)
            pressed.append(beyond)
    v, beyond = (_smooth(np.concatenate(parts)) for parts in (moved, pressed))
    reference = np.zeros((len(v), 5))
    reference[:, X_REF] = home + STEP_S * np.concatenate([[0.0], np.cumsum(v[:-1])]) + beyond
    reference[:, V_REF] = v
    reference[:, SUPPLY] = supply
    return Segment(NAME, reference)


def _smooth(values: FloatArray) -> FloatArray:
    """A moving average over EASE_S, m or m/s, (n,): its sum is the same where it ends at rest."""
    width = round(EASE_S / STEP_S)
    return np.convolve(values, np.ones(width) / width)[: len(values)]


def _there_and_back(
    way: float, past: float, most_mps: float
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Speed of the reference, m/s, and how far it is past the stop, m, phase by phase (n,)."""
    side = float(np.sign(way))

    def run(length: float, pace: float) -> tuple[FloatArray, FloatArray]:
        n = max(1, round(abs(length) / (pace * most_mps) / STEP_S))
        return np.full(n, length / (n * STEP_S)), np.zeros(n)

    press, still = (round(s / STEP_S) for s in (PRESS_S, REST_AT_STOP_S))
    calm = np.zeros(round(CALM_S / STEP_S))
    up = side * past * np.linspace(0.0, 1.0, press)
    yield run((1.0 - LAST) * way, PACE)
    yield run(LAST * way, CREEP)
    yield calm, calm
    yield np.zeros(press), up
    yield np.zeros(still), np.full(still, side * past)
    yield np.zeros(press), up[::-1]
    yield calm, calm
    yield run(-LAST * way, CREEP)
    yield run(-(1.0 - LAST) * way, PACE)
    yield calm, calm


def with_rests(design: Design, rests: Segment, limits: Limits) -> Design:
    """A design with the rests behind it, run as a whole between the stops; checked anew.

    A chamber that is joined to tank or supply has its pressure; a map of blocks, which knows no
    corner at dp = 0, is off by NEAR_PA.
    """
    stops = limits.stops_m or limits.stroke_m
    least = min(limits.pressure_pa[0], design.machine.tank_pa - NEAR_PA)
    most = max(limits.pressure_pa[1], float(rests.reference[0, SUPPLY]) + NEAR_PA)
    piston = design.machine.piston._replace(least_m=stops[0], most_m=stops[1])
    machine = replace(design.machine, piston=piston)
    wide = replace(limits, stroke_m=stops, pressure_pa=(least, most))
    told = of_blocks(machine, machine.measured(machine.run(rests.reference)))
    segments = (*design.segments, CandidateSegment(rests, told))
    kept, reference, _ = stitched(segments, wide)
    expected = machine.run(reference)
    result = checked(machine, wide, reference, expected)
    require_kept(result)
    return Design(machine, wide, tuple(kept), reference, expected, result, design.weights)
