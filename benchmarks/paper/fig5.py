"""Fig. 5: one-dimensional maps at fixed commands, with their intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.paper.fig5_picture import draw
from benchmarks.paper.result import Measure, Part, Table, at_least, at_most
from benchmarks.paper.slices import COMMANDS_V, Slice, one_dimensional
from rtid.plain import FloatArray


def reproduce(seed: int = 0) -> Part:
    """Fig. 5 with its numbers."""
    slices = [one_dimensional(w_v, seed) for w_v in COMMANDS_V]
    errors = np.concatenate([s.error for s in slices])
    covered = np.concatenate([s.covered for s in slices])
    span = min(float(np.ptp(s.dp_pa)) for s in slices)
    text = (
        "At 3, 4, 5 and 6 V the command is held at + or - this value while the boom moves to and "
        "fro for 60 s and the supply swings; blocks have terms in the pressure drop alone, no "
        "orifice law bends them. Errors are shares of the largest flow at the same command, over "
        "the middle 98 % of the pressure drops that were seen."
    )
    measures = (
        at_most("mean error", 100 * errors.mean(), 0.5, "%"),
        at_most("largest error", 100 * errors.max(), 1.5, "%"),
        at_least("truth within the 95 % interval", 100 * covered.mean(), 93.0, "%"),
        Measure("median standard deviation", 100 * float(np.median(_spread(slices))), "%"),
        Measure("pressure drops covered, at least", 1e-6 * span, "MPa"),
    )
    title = "Fig. 5: one-dimensional maps at fixed commands"
    return Part("fig5", title, text, measures, (_table(slices),), {"fig5": draw(slices)})


def _spread(slices: Sequence[Slice]) -> FloatArray:
    return np.concatenate([s.sd / s.true.max() for s in slices])


def _table(slices: Sequence[Slice]) -> Table:
    rows = []
    for s in slices:
        span = f"{1e-6 * s.dp_pa[0]:.2f} to {1e-6 * s.dp_pa[-1]:.2f}"
        values = s.error.mean(), s.error.max(), np.median(_spread([s])), s.covered.mean()
        rows.append((f"{s.w_v:g} V", span, *(f"{100 * v:.3g} %" for v in values)))
    head = ("command", "dp in MPa", "mean error", "largest", "median sd", "within 95 % interval")
    return Table("Each map:", head, tuple(rows))
