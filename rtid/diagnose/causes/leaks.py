"""Leaks past pistons, out of chambers and through the seats of shut valves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rtid.diagnose.candidates import (
    LAMINAR,
    TURBULENT,
    Candidate,
    Cause,
    Shape,
    Volumes,
    fixed,
)
from rtid.diagnose.causes.common import ssqrt
from rtid.diagnose.view import View
from rtid.model import Edge, FloatArray

GROOVE_M = 0.03  # half length of a worn place
GROOVES = 5  # places along the stroke where a wall may be worn


def leaks(view: View) -> Iterator[Cause]:
    """Past the piston, where there are two chambers, and out of each."""
    names = [c.name for c in view.model.chambers]
    if len(names) == 2:
        yield from _internal(view, f"{names[0]}-{names[1]}")
    for c, name in enumerate(names):
        drop = view.pressure(c) - view.tank
        for effect, unit, most, flow in (
            ("external_leakage_laminar", LAMINAR, 1e-9, drop),
            ("external_leakage_turbulent", TURBULENT, 1e-6, ssqrt(drop)),
        ):
            yield fixed(
                Candidate(effect, name, "coefficient", unit, most),
                _out, view, c, flow,
            )  # fmt: skip


def _out(view: View, c: int, flow: FloatArray) -> Volumes:
    return {c: -view.over_intervals(flow)}


def _between(view: View, flow: FloatArray) -> Volumes:
    volume = view.over_intervals(flow)
    return {0: -volume, 1: volume}


def _internal(view: View, where: str) -> Iterator[Cause]:
    drop = view.pressure(0) - view.pressure(1)

    for effect, unit, most, flow in (
        ("internal_leakage_laminar", LAMINAR, 1e-9, drop),
        ("internal_leakage_turbulent", TURBULENT, 1e-6, ssqrt(drop)),
    ):
        yield fixed(Candidate(effect, where, "coefficient", unit, most), _between, view, flow)
    low, high = float(view.x_m.min()), float(view.x_m.max())

    def worn(shape: Shape) -> Volumes:
        near = np.clip(1.0 - np.abs(view.x_m - shape[0]) / GROOVE_M, 0.0, 1.0)
        return _between(view, drop * near)

    yield Cause(
        Candidate("position_dependent_leakage", where, "coefficient", LAMINAR, 1e-9,
                  shape_names=("position",), shape_units=("m",)),
        worn, (tuple(float(v) for v in np.linspace(low, high, GROOVES)),),
        offered=high - low > GROOVE_M,
    )  # fmt: skip


def seats(view: View) -> Iterator[Cause]:
    """Through every metering edge, however far it is shut."""
    for edge in view.model.edges:
        signs = {c: edge.sign(chamber) for c, chamber in enumerate(view.model.chambers)}

        def make(edge: Edge = edge, signs: dict[int, int] = signs) -> Volumes:
            volume = view.over_intervals(ssqrt(view.signal(edge.source) - view.signal(edge.sink)))
            return {c: sign * volume for c, sign in signs.items() if sign}

        yield fixed(
            Candidate("valve_seat_leakage", edge.name, "coefficient", TURBULENT, 1e-6), make
        )
