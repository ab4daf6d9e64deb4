"""Fig. 6 with a hidden effect: tracking before it is known, and after it has been added.

A piston seal leaks, and nobody told the model.  The boom is commissioned all the same; its owner
diagnoses the frames and adds what is named, or, where nothing is, by `--force` what comes first of
all that is listed as too small to matter; maps are learned anew beside it.  The controller gets the
new maps, and the leakage to make up for.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from benchmarks.paper.commissioning import (
    FIRST,
    Commissioned,
    commission,
    machines,
    over_the_bridge,
)
from benchmarks.paper.fig6 import MOST_PLANTS, repeated
from benchmarks.paper.fig6_picture import CALIBRATED, MANUFACTURER, rms_m
from benchmarks.paper.learning import logged
from benchmarks.paper.result import Measure, Part, Table, at_least
from rtid.diagnose.extend import RefusedError
from rtid.estimator.published import publish
from rtid.project import load
from rtid.sim.boom_references import point_to_point
from rtid.sim.hidden import hide_wish
from rtid.sim.programmable import five_valves, manufacturer
from rtid.sim.robust import Knowledge, received, sampled
from rtid.study.replay import replay
from rtid.study.revisions import add
from rtid.study.study import diagnose_trace

EFFECT = "internal_leakage_laminar"
BEFORE, AFTER = "estimated, before", "estimated, after"
KINDS = CALIBRATED, BEFORE, AFTER, MANUFACTURER
LEVEL = "strong"
SHARE = 3  # one machine for so many of Fig. 6: each takes a diagnosis


@dataclass(frozen=True)
class Worn:
    """One machine: what leaks, what was added (0: nothing), and the rms error with each map, m.

    named: whether the diagnosis called it missing.
    """

    number: int
    named: bool
    true_m3spa: float
    found_m3spa: float
    rms_m: dict[str, float]


def learned_beside(commissioned: Commissioned) -> tuple[Knowledge, bool]:
    """What is known once what was found is part of the model, and whether it was named.

    The size told is that of the file; the maps are those of both sweeps beside it.
    """
    with logged(commissioned.plant, commissioned.model, commissioned.frames) as (path, trace):
        diagnosis = diagnose_trace(load(path), trace).diagnosis
        listed = [(e.effect, e.where) for e in diagnosis.found or diagnosis.negligible]
        with suppress(RefusedError):
            if listed:
                add(path, trace, *listed[0], force=not diagnosis.found)
        project = load(path)
        flowmap = publish(replay(project, trace).fit.solution)
    sizes = (a.parameters["coefficient"] for a in project.sections.added if a.effect == EFFECT)
    leak = sum(size.value for size in sizes)
    named = any(effect.effect == EFFECT for effect in diagnosis.found)
    return Knowledge(received(over_the_bridge(commissioned.model, flowmap)), leak), named


def compare(number: int) -> Worn:
    """Commission the worn boom, add what is missing, and track.  Raises SimulationError."""
    plant = hide_wish(five_valves(number), f"{EFFECT}={LEVEL}")
    commissioned = commission(plant, number)
    (after, named), true = learned_beside(commissioned), plant.extra.internal_laminar
    known = {
        CALIBRATED: Knowledge(sampled(plant.flow), true),
        BEFORE: Knowledge(received(commissioned.rounds[-1].tables)),
        AFTER: after,
        MANUFACTURER: Knowledge(sampled(manufacturer(plant, number))),
    }
    reference = point_to_point(plant)
    rms = {
        k: rms_m(repeated(plant, knowledge, reference, number)) for k, knowledge in known.items()
    }
    return Worn(number, named, true, after.leak_m3spa, rms)


def reproduce(seed: int = 0, plants: int = 30) -> Part:
    """Fig. 6 on worn machines, before and after the effect is added."""
    worns = list(machines(compare, max(plants // SHARE, 1), FIRST + seed))
    rms = {kind: np.array([w.rms_m[kind] for w in worns]) for kind in KINDS}
    size = np.array([w.found_m3spa / w.true_m3spa for w in worns])
    text = (
        f"{len(worns)} of these booms with a piston seal that leaks {worns[0].true_m3spa:.2g} "
        "m3/s/Pa, unknown to the model and to the controller. The frames of the two sweeps are "
        "diagnosed; what is named is added, or what is first of the effects listed as too small to "
        "matter (0.3 % of the flow); maps are learned anew beside it, and the controller makes up "
        "for the leakage that it is told. Calibrated: true maps and true leakage."
    )
    order = (rms[AFTER] < rms[BEFORE]) & (rms[AFTER] < rms[MANUFACTURER])
    measures = (
        at_least("found and added", float(100 * np.mean(size > 0)), MOST_PLANTS, "%"),
        Measure("of these called missing", float(100 * np.mean([w.named for w in worns])), "%"),
        at_least(
            "after better than before and than manufacturer's",
            float(100 * order.mean()), MOST_PLANTS, "%",
        ),
        Measure("median rms, before / calibrated", float(np.median(rms[BEFORE] / rms[CALIBRATED]))),
        Measure("median rms, after / calibrated", float(np.median(rms[AFTER] / rms[CALIBRATED]))),
        Measure("size found / true, median", float(np.median(size))),
    )  # fmt: skip
    rows = tuple(
        (kind, f"{1e3 * np.median(rms[kind]):.3g}", f"{1e3 * rms[kind].max():.3g}")
        for kind in KINDS
    )
    table = Table("Over all machines:", ("map", "rms in mm, median", "worst"), rows)
    return Part("hidden", "Fig. 6 with a hidden effect", text, measures, (table,), {})
