"""Fig. 6: one controller, five valves, three maps: calibrated, estimated, manufacturer's.

The manufacturer's map is the true one of each valve with up to 10 % of gain and up to 0.3 V of dead
band wrong, drawn from the machine's number before anything is fitted.  The estimated one is what
two sweeps taught, the first one driven with the data sheet, the second with what the first taught
(`commissioning`).  Each motion is repeated with other sensor noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.paper.commissioning import FIRST, commission, machines
from benchmarks.paper.fig6_picture import (
    CALIBRATED,
    ESTIMATED,
    FIRST_SWEEP,
    KINDS,
    MANUFACTURER,
    Compared,
    draw,
)
from benchmarks.paper.result import Measure, Part, Table, at_least, at_most
from rtid.plain import FloatArray
from rtid.sim.boom_references import point_to_point
from rtid.sim.programmable import five_valves, manufacturer
from rtid.sim.robust import Knowledge, Tracked, received, run, sampled
from rtid.sim.simulated_plant import SimulatedPlant

REPEATS = 8
MOST_PLANTS, LARGEST_RATIO = 90.0, 1.05
NO_REGENERATION = "calibrated, without regeneration"


def repeated(
    plant: SimulatedPlant, known: Knowledge, reference: FloatArray, number: int
) -> tuple[Tracked, ...]:
    """The same motion with other noise; the same noise for every map."""
    return tuple(run(plant, known, reference, 100 * number + k) for k in range(REPEATS))


def compare(number: int) -> Compared:
    """Commission the boom, then track with each map.  Raises SimulationError."""
    plant = five_valves(number)
    rounds = commission(plant, number).rounds
    true = sampled(plant.flow)
    known = {
        CALIBRATED: Knowledge(true),
        ESTIMATED: Knowledge(received(rounds[-1].tables)),
        FIRST_SWEEP: Knowledge(received(rounds[0].tables)),
        MANUFACTURER: Knowledge(sampled(manufacturer(plant, number))),
        NO_REGENERATION: Knowledge(true, may_regenerate=False),
    }
    reference = point_to_point(plant)
    runs = {
        kind: repeated(plant, knowledge, reference, number) for kind, knowledge in known.items()
    }
    return Compared(number, reference, runs)


def reproduce(seed: int = 0, plants: int = 30) -> Part:
    """Fig. 6 with its numbers, on so many random machines."""
    compared = list(machines(compare, plants, FIRST + seed))
    rms = {kind: np.array([c.rms_m(kind) for c in compared]) for kind in compared[0].runs}
    ratio = rms[ESTIMATED] / rms[CALIBRATED]
    better = rms[ESTIMATED] < rms[MANUFACTURER]
    spared = np.array([c.energy_j(CALIBRATED) / c.energy_j(NO_REGENERATION) for c in compared])
    text = (
        f"{plants} random booms on five independently commanded valves follow a smooth "
        "point-to-point motion under the same controller (Liu and Yao, gains 16, adaptation off; "
        "lowering, it regenerates through the cross-port valve as far as the pressures allow) with "
        "three maps: the true one, the one learned before from the frames of two sweeps, and a "
        "data sheet with up to 10 % of gain and 0.3 V of dead band wrong per valve. The first "
        "sweep is driven with the data sheet, the second with what the first taught; maps reach "
        "the controller as the look-up tables of the download. The controller knows the other "
        f"constants of the machine. Errors are over {REPEATS} repetitions with other sensor noise."
    )
    measures = (
        at_least("estimated better than manufacturer's", 100 * better.mean(), MOST_PLANTS, "%"),
        at_least(
            "calibrated <= estimated < manufacturer's",
            100 * np.mean((ratio >= 1) & better), MOST_PLANTS, "%", "1 of 1",
        ),
        Measure(
            "the same where noise does not decide",
            float(100 * np.mean([c.in_order_but_for_noise for c in compared])), "%",
        ),
        at_most("median rms, estimated / calibrated", float(np.median(ratio)), LARGEST_RATIO),
        Measure("largest rms, estimated / calibrated", float(ratio.max())),
        Measure(
            "median rms, after the first sweep / calibrated",
            float(np.median(rms[FIRST_SWEEP] / rms[CALIBRATED])),
        ),
        Measure(
            "median rms, manufacturer's / calibrated",
            float(np.median(rms[MANUFACTURER] / rms[CALIBRATED])),
        ),
        Measure("energy with regeneration / without, median", float(np.median(spared))),
        Measure(
            "left out: lost on the first sweep, under the data sheet",
            compared[-1].number + 1 - FIRST - seed - plants, "booms",
        ),
    )  # fmt: skip
    title = "Fig. 6: tracking with different flow maps"
    return Part("fig6", title, text, measures, (_table(compared),), {"fig6": draw(compared[0])})


def _table(compared: Sequence[Compared]) -> Table:
    rows = []
    for kind in (*KINDS, NO_REGENERATION):
        rms = [1e3 * c.rms_m(kind) for c in compared]
        largest = [1e3 * max(r.largest_m for r in c.runs[kind]) for c in compared]
        energy = [1e-3 * c.energy_j(kind) for c in compared]
        values = (np.median(rms), max(rms), np.median(largest), np.median(energy))
        rows.append((kind, *(f"{v:.3g}" for v in values)))
    head = (
        "map",
        "rms in mm, median",
        "worst",
        "largest error in mm, median",
        "energy in kJ, median",
    )
    return Table("Over all machines:", head, tuple(rows))
