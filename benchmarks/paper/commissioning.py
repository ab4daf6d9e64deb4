"""A boom with five valves is commissioned: sweep, learn, load the map, sweep again, learn on.

Each round the controller follows the paper's sweep with the map that it has, first that of the data
sheet; its frames are all that is learned from.  The map comes back as the bytes that the bridge
loads into a controller (`firmware_bridge.lookup`): tables of limited size, flows in 16 bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

from benchmarks.paper.learning import Learned, learn_frames
from firmware_bridge.frames import Frames, concatenate
from firmware_bridge.lookup import Table, image, table_of
from rtid.estimator.flowmap import FlowMap
from rtid.maps.lookup import sample
from rtid.model import Machine
from rtid.sim.boom_references import swept
from rtid.sim.bus import tracked_frames
from rtid.sim.programmable import declared, lost, manufacturer
from rtid.sim.robust import Knowledge, Tracked, received, run, sampled
from rtid.sim.run import SimulationError
from rtid.sim.run_files import START_US
from rtid.sim.simulated_plant import SimulatedPlant

Found = TypeVar("Found")

FIRST = 3000  # number of the first random machine; nothing was chosen on these
ROUNDS = 2
PAUSE_US = 1_000_000  # between two sweeps


@dataclass(frozen=True)
class Round:
    """One sweep: what the controller did, and what all frames so far have taught."""

    tracked: Tracked
    learned: Learned
    tables: tuple[Table, ...]


@dataclass(frozen=True)
class Commissioned:
    """A boom, its declaration, the frames of all rounds and what each round taught."""

    plant: SimulatedPlant
    model: Machine
    frames: Frames
    rounds: tuple[Round, ...]


def over_the_bridge(model: Machine, flowmap: FlowMap) -> tuple[Table, ...]:
    """The map as a controller has it: through the images of the download and back."""
    tables = (sample(edge, flowmap[edge.name]).table for edge in model.edges)
    return tuple(table_of(image(table, slot)) for slot, table in enumerate(tables))


def commission(plant: SimulatedPlant, number: int, rounds: int = ROUNDS) -> Commissioned:
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


def machines(compare: Callable[[int], Found], count: int, first: int = FIRST) -> Iterator[Found]:
    """What `compare` finds of so many; one that gets lost under its data sheet is left out."""
    number, done = first, 0
    while done < count:
        with suppress(SimulationError):
            worn = compare(number)
            yield worn
            done += 1
        number += 1
