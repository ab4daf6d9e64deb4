"""Records of a machine that changes: pieces of motion, each of a plant with other valve gains."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from rtid.estimator.chunk import to_chunk
from rtid.estimator.flowmap import FlowMap
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.sim.demand import Motion, rich, swept_sine
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import EDGES, SimulatedPlant

PIECE_S = 10.0


def with_gain(plant: SimulatedPlant, factor: float) -> SimulatedPlant:
    """The same machine with all valve gains times a factor."""
    valves = tuple(replace(v, gain=v.gain * factor) for v in plant.valves)
    return replace(plant, valves=valves)


def timid(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
    """A small slow motion about the middle: few blocks are visited."""
    return swept_sine(plant, rng, duration_s, 0.02, (0.1, 0.2))


def pieces(
    plant: SimulatedPlant,
    model: Machine,
    gain: Callable[[float], float],
    duration_s: float,
    start_s: float = 0.0,
    motion: Motion = rich,
) -> Iterator[tuple[float, FloatArray]]:
    """(time at the end, chunk) of each piece; gain (time): factor on the plant's gains."""
    for k in range(round(duration_s / PIECE_S)):
        at_s = start_s + k * PIECE_S
        aged = with_gain(plant, gain(at_s + 0.5 * PIECE_S))
        run = simulate(aged, motion, round(at_s), PIECE_S)
        chunk = to_chunk(model, run.samples, 0)
        chunk[:, 0] += at_s
        yield at_s + PIECE_S, chunk


def points_of(plant: SimulatedPlant, model: Machine, duration_s: float = 60.0) -> list[FloatArray]:
    """Per edge: opening, pressure drop and true flow (n, 3) along a record of its own."""
    run = simulate(plant, rich, 9999, duration_s)
    value = {name: run.truth.signals[:, k] for k, name in enumerate(run.samples.names)}
    points = []
    for edge in model.edges:
        w = run.truth.opening_v[:, EDGES.index(edge.name)]
        table = np.column_stack(
            [w, value[edge.source] - value[edge.sink], run.truth.flow(edge.name)]
        )
        points.append(table[w > edge.safe_band_v][::20])
    return points


def map_error(published: FlowMap, points: list[FloatArray], gain: float) -> FloatArray:
    """Error at the test points of a plant with `gain`, as shares of each edge's largest flow."""
    errors = []
    for edge, (w, dp, flow) in zip(published.edges, (p.T for p in points), strict=True):
        true = gain * flow
        errors.append((edge.flow(w, dp) - true) / np.abs(true).max())
    return np.concatenate(errors)
