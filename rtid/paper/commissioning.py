"""A boom with five valves is commissioned: sweep, learn, load the map, sweep again, learn on.

Each round the controller follows the paper's sweep with the map that it has, first that of the data
sheet; its frames are all that is learned from.  The map comes back as the bytes that the bridge
loads into a controller (`firmware_bridge.lookup`): tables of limited size, flows in 16 bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from firmware_bridge.frames import Frames, concatenate
from firmware_bridge.lookup import Table, image, table_of
from rtid.estimator.flowmap import FlowMap
from rtid.lookup import sample
from rtid.model import Grid, Model
from rtid.paper.boom import Learned, boom, learn_frames, write_boom
from rtid.paper.references import swept
from rtid.sim.bus import tracked_frames
from rtid.sim.declare import declared_model
from rtid.sim.log import START_US
from rtid.sim.plant import EDGES, FloatArray, Plant
from rtid.sim.robust import Flow, Knowledge, Tracked, received, run, sampled
from rtid.sim.run import SimulationError

Found = TypeVar("Found")

FIRST = 3000  # number of the first random machine; nothing was chosen on these
GAIN_ERROR, DEADBAND_ERROR_V = 0.1, 0.3
ROUNDS = 2
PAUSE_US = 1_000_000  # between two sweeps
DP_STEP_PA = 0.5e6


@dataclass(frozen=True)
class Round:
    """One sweep: what the controller did, and what all frames so far have taught."""

    tracked: Tracked
    learned: Learned
    tables: tuple[Table, ...]


@dataclass(frozen=True)
class Commissioned:
    """A boom, its declaration, the frames of all rounds and what each round taught."""

    plant: Plant
    model: Model
    frames: Frames
    rounds: tuple[Round, ...]


def five_valves(number: int) -> Plant:
    """The random boom with this number; each valve opens with a positive command of its own."""
    return replace(boom(number), directions=(1,) * len(EDGES))


def declared(plant: Plant, seed: int) -> Model:
    """What its user declares: unknown maps, fine where the dead band may end."""
    fine, coarse = np.linspace(1.0, 4.0, 13), np.linspace(4.0, 10.0, 13)[1:]
    drops = np.linspace(0.0, 9e6, round(9e6 / DP_STEP_PA) + 1)
    grid = Grid(np.concatenate([fine, coarse]), drops)
    return declared_model(plant, grid=grid, seed=seed, one_by_one=True)


def manufacturer(plant: Plant, number: int) -> Flow:
    """What a data sheet says: each valve up to 10 % of gain and 0.3 V of dead band wrong."""
    rng = np.random.default_rng([number, 6])
    four = len(EDGES) - 1  # the cross-port valve is drawn last
    gain = rng.uniform(1 - GAIN_ERROR, 1 + GAIN_ERROR, four)
    shift_v = rng.uniform(-DEADBAND_ERROR_V, DEADBAND_ERROR_V, four)
    gain = np.append(gain, rng.uniform(1 - GAIN_ERROR, 1 + GAIN_ERROR))
    shift_v = np.append(shift_v, rng.uniform(-DEADBAND_ERROR_V, DEADBAND_ERROR_V))

    def flow(edge: str, w: FloatArray, dp: FloatArray) -> FloatArray:
        k = EDGES.index(edge)
        return np.asarray(gain[k] * plant.flow(edge, w - shift_v[k], dp))

    return flow


def over_the_bridge(model: Model, flowmap: FlowMap) -> tuple[Table, ...]:
    """The map as a controller has it: through the images of the download and back."""
    tables = (sample(edge, flowmap[edge.name]).table for edge in model.edges)
    return tuple(table_of(image(table, slot)) for slot, table in enumerate(tables))


def record_sweep(trace: Path, plant: Plant, number: int) -> list[Path]:
    """Write the first sweep of a commissioning and its project file.  Raises SimulationError."""
    reference, known = swept(plant), Knowledge(sampled(manufacturer(plant, number)))
    tracked = run(plant, known, reference, number)
    if fault := lost(plant, tracked, reference):
        raise SimulationError(fault)
    frames = tracked_frames(tracked, reference, START_US)
    return [trace, write_boom(trace, plant, declared(plant, number), frames)]


def commission(plant: Plant, number: int, rounds: int = ROUNDS) -> Commissioned:
    """So many rounds, from the data sheet on.

    Raises SimulationError where the boom gets lost under the data sheet.  Where it gets lost
    under a learned map there are no more rounds: that map has to do, and is judged.
    """
    model, reference = declared(plant, number), swept(plant)
    known = Knowledge(sampled(manufacturer(plant, number)))
    done: list[Round] = []
    frames: list[Frames] = []
    for turn in range(rounds):
        tracked = run(plant, known, reference, number + 100_000 * turn)
        if fault := lost(plant, tracked, reference):
            if not done:
                raise SimulationError(fault)
            break
        start_us = START_US + turn * (1000 * len(reference) + PAUSE_US)
        frames.append(tracked_frames(tracked, reference, start_us))
        learned = learn_frames(plant, model, concatenate(frames))
        done.append(Round(tracked, learned, over_the_bridge(model, learned.flowmap)))
        known = Knowledge(received(done[-1].tables))
    return Commissioned(plant, model, concatenate(frames), tuple(done))


def lost(plant: Plant, tracked: Tracked, reference: FloatArray) -> str:
    """In what way a boom got lost, empty if it did not."""
    x = tracked.error_m + reference[:, 0]
    if not ((x > 0) & (x < plant.constants.stroke_m)).all():
        return "the boom leaves its stroke"
    return "" if (tracked.true_pa > 1e4).all() else "the boom cavitates"


def machines(compare: Callable[[int], Found], count: int, first: int = FIRST) -> Iterator[Found]:
    """What `compare` finds of so many; one that gets lost under its data sheet is left out."""
    number, done = first, 0
    while done < count:
        with suppress(SimulationError):
            found = compare(number)
            yield found
            done += 1
        number += 1
