"""Fig. 6: one controller with three maps, on random booms: calibrated, estimated, manufacturer's.

The manufacturer's map is the true one of each valve with up to 10 % of gain and up to 0.3 V of dead
band wrong, drawn from the machine's number before anything is fitted.  The estimated one is learned
from the frames of the paper's sweep, before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress

import numpy as np

from rtid.paper.boom import TOP_V, Learned, boom, grid, learn
from rtid.paper.fig6_picture import CALIBRATED, ESTIMATED, KINDS, MANUFACTURER, Compared, draw
from rtid.paper.result import Measure, Part, Table, at_least, at_most
from rtid.sim.motion import DT_S
from rtid.sim.plant import EDGES, FloatArray, Plant
from rtid.sim.robust import FOUR, Flow, run
from rtid.sim.run import SimulationError

GAIN_ERROR, DEADBAND_ERROR_V = 0.1, 0.3
FIRST = 2000  # number of the first random machine
MOVE, SPEED = 0.3, 0.6  # of the stroke; of the sweep's highest speed
HOLD_S = 2.0
DP_STEP_PA = (
    1e6  # the moves need flows where the sweep has been little: larger blocks reach further
)
MOST_PLANTS, LARGEST_RATIO = 90.0, 1.05


def manufacturer(plant: Plant, number: int) -> Flow:
    """What a data sheet says of these valves."""
    rng = np.random.default_rng([number, 6])
    gain = rng.uniform(1 - GAIN_ERROR, 1 + GAIN_ERROR, len(FOUR))
    shift_v = rng.uniform(-DEADBAND_ERROR_V, DEADBAND_ERROR_V, len(FOUR))

    def flow(edge: str, w: FloatArray, dp: FloatArray) -> FloatArray:
        k = EDGES.index(edge)
        return np.asarray(gain[k] * plant.flow(edge, w - shift_v[k], dp))

    return flow


def estimated(found: Learned) -> Flow:
    """The published map; beyond its grid the value at the border."""

    def flow(edge: str, w: FloatArray, dp: FloatArray) -> FloatArray:
        u, p = found.flowmap[edge].grid.u_v, found.flowmap[edge].grid.dp_pa
        inside = np.clip(w, u[0], u[-1]), np.clip(dp, p[0], p[-1])
        return found.flowmap[edge].flow(*inside)

    return flow


def point_to_point(plant: Plant) -> FloatArray:
    """Hold, up, hold, down, hold: x, v, a and jerk (n, 4) of moves of fifth order in time."""
    k, c = plant.controller, plant.constants
    way_m = MOVE * c.stroke_m
    top_mps = SPEED * (TOP_V - k.deadband_v) / k.volts_per_mps
    move_s = 1.875 * way_m / top_mps
    s = np.arange(round(move_s / DT_S)) * DT_S / move_s
    up = way_m * np.stack(
        [
            s**3 * (10 - 15 * s + 6 * s**2),
            30 * s**2 * (1 - s) ** 2 / move_s,
            (60 * s - 180 * s**2 + 120 * s**3) / move_s**2,
            (60 - 360 * s + 360 * s**2) / move_s**3,
        ],
        axis=1,
    )
    still, top = np.zeros((round(HOLD_S / DT_S), 4)), np.array([way_m, 0, 0, 0])
    whole = np.concatenate([still[: len(still) // 4], up, still + top, top - up, still])
    whole[:, 0] += 0.5 * (c.stroke_m - way_m)
    return whole


def compare(number: int) -> Compared:
    """Learn from the sweep, then track with each map.  Raises SimulationError."""
    plant = boom(number)
    sheet = manufacturer(plant, number)
    maps = {
        CALIBRATED: plant.flow,
        ESTIMATED: estimated(learn(plant, number, blocks=grid(dp_step_pa=DP_STEP_PA))),
        MANUFACTURER: sheet,
    }
    reference = point_to_point(plant)
    runs = {kind: run(plant, flow, reference, number) for kind, flow in maps.items()}
    return Compared(number, reference, runs)


def machines(count: int, first: int = FIRST) -> Iterator[Compared]:
    """So many machines; one that cannot follow the sweep is left out."""
    number, done = first, 0
    while done < count:
        with suppress(SimulationError):
            found = compare(number)
            yield found
            done += 1
        number += 1


def reproduce(seed: int = 0, plants: int = 30) -> Part:
    """Fig. 6 with its numbers, on so many random machines."""
    found = list(machines(plants, FIRST + seed))
    rms = np.array([[c.runs[kind].rms_m for kind in KINDS] for c in found])
    ratio = rms[:, 1] / rms[:, 0]
    better = 100 * float(np.mean(rms[:, 1] < rms[:, 2]))
    in_order = 100 * float(np.mean((ratio >= 1) & (rms[:, 1] < rms[:, 2])))
    text = (
        f"{plants} random booms on four independently commanded valves follow a smooth "
        "point-to-point motion under the same controller (Liu and Yao, gains 16, adaptation off) "
        "with three maps: the true one, the one learned before from the frames of the paper's "
        "sweep, and a data sheet with up to 10 % of gain and 0.3 V of dead band wrong per valve. "
        "The controller knows the machine's other constants. No cross-port valve, no regeneration; "
        "the stroke has no ends, so that a boom whose data sheet is too wrong may run away."
    )
    measures = (
        at_least("estimated better than manufacturer's", better, MOST_PLANTS, "%", "1 of 1"),
        at_least("calibrated <= estimated < manufacturer's", in_order, MOST_PLANTS, "%", "1 of 1"),
        at_most("median rms, estimated / calibrated", float(np.median(ratio)), LARGEST_RATIO),
        Measure("largest rms, estimated / calibrated", float(ratio.max())),
        Measure("median rms, manufacturer's / calibrated", float(np.median(rms[:, 2] / rms[:, 0]))),
    )
    title = "Fig. 6: tracking with different flow maps"
    return Part("fig6", title, text, measures, (_table(found),), {"fig6": draw(found[0])})


def _table(found: Sequence[Compared]) -> Table:
    rows = []
    for kind in KINDS:
        runs = [c.runs[kind] for c in found]
        values = [1e3 * np.median([r.rms_m for r in runs]), 1e3 * max(r.rms_m for r in runs)]
        values += [1e3 * np.median([r.largest_m for r in runs])]
        values += [1e-3 * np.median([r.energy_j for r in runs])]
        rows.append((kind, *(f"{v:.3g}" for v in values)))
    head = (
        "map",
        "rms in mm, median",
        "worst",
        "largest error in mm, median",
        "energy in kJ, median",
    )
    return Table("Over all machines:", head, tuple(rows))
