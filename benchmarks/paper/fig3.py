"""Fig. 3: a non-smooth function of two variables, true and estimated, with and without windows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.paper.fig3_picture import draw
from benchmarks.paper.function import THETA, grid, record
from benchmarks.paper.result import Measure, Part, Table, at_most
from benchmarks.paper.surface import errors, excess, jumps, learn, rms
from rtid.model import BLENDED, LAPPED, TAYLOR
from rtid.plain import FloatArray

KNOWN = 0.01  # share of full scale
FINE = 0.25  # spacing between u = 1 and 2
SPACINGS = (  # name, spacing between u = 1 and 2, elsewhere
    ("equal, coarse", 1.0, 1.0),
    ("fine from 1 to 2", 0.5, 1.0),
    ("fine from 1 to 2", 0.25, 1.0),
    ("fine from 1 to 2", 0.125, 1.0),
    ("equal, fine", 0.25, 0.25),
)
SURFACES = (TAYLOR, LAPPED, BLENDED)  # bases of a function of two variables


def reproduce(seed: int = 0, spacings: Sequence[tuple[str, float, float]] = SPACINGS) -> Part:
    """Fig. 3 with its numbers; spacings: (name, spacing between 1 and 2, elsewhere) to compare."""
    chunk = record(seed)
    estimates = {basis: learn(chunk, grid(FINE), basis) for basis in SURFACES}
    taylor, lapped = estimates[TAYLOR], estimates[LAPPED]
    raw, windowed = taylor.unwindowed, taylor.published.flow
    without = rms(jumps(taylor.grid, raw))
    jump = rms(jumps(taylor.grid, windowed)), rms(jumps(lapped.grid, lapped.windowed))
    steep = [rms(excess(taylor.grid, f)) for f in (raw, windowed, lapped.windowed)]
    worst = max(100 * rms(errors(e)) for e in estimates.values())
    theta, sd = taylor.solution.terms[0], float(np.sqrt(taylor.solution.terms_cov[0, 0]))
    measures = (
        at_most("rms error, Taylor blocks", 100 * rms(errors(taylor)), 1.0, "%"),
        at_most("rms error, lapped basis", 100 * rms(errors(lapped)), 1.0, "%"),
        at_most("rms error, worst of three bases", worst, 1.0, "%"),
        Measure("largest error, Taylor blocks", 100 * float(np.abs(errors(taylor)).max()), "%"),
        Measure("jump at borders, no windows", 100 * without, "%"),
        at_most("jump left under windows, Taylor", 100 * jump[0] / without, 10.0, "%"),
        at_most("jump left, lapped basis", 100 * jump[1] / without, 10.0, "%"),
        at_most("excess left under windows, Taylor", 100 * steep[1] / steep[0], 10.0, "%"),
        at_most("excess left, lapped basis", 100 * steep[2] / steep[0], 10.0, "%"),
        Measure("valid blocks", 100 * taylor.valid_share, "%"),
        at_most("theta, error in standard deviations", abs(theta - THETA) / sd, 3.0),
    )
    text = (
        "A simulated plant dx/dt = f(u, x) + theta d with a dead band that ends between u = 1 and "
        "2, elsewhere for every x, sends u, x and d as CAN frames; f and theta are learned "
        "together. Errors are shares of full scale on valid blocks. A jump is a change over a "
        "hundredth of a block at a border that the slopes on either side do not explain, the "
        "excess the change less that of the truth; what windows leave of either is a share of "
        "what stands without them."
    )
    return Part(
        "fig3",
        "Fig. 3: estimation of a two-dimensional function",
        text,
        measures,
        (_spacing_table(chunk, spacings),),
        {"fig3": draw(taylor, lapped)},
    )


def _spacing_table(chunk: FloatArray, spacings: Sequence[tuple[str, float, float]]) -> Table:
    rows = []
    for name, fine, coarse in spacings:
        taylor, lapped = (learn(chunk, grid(fine, coarse), basis) for basis in (TAYLOR, LAPPED))
        values = (
            rms(errors(taylor)),
            _largest(errors(taylor)),
            rms(errors(taylor, KNOWN)),
            rms(jumps(taylor.grid, taylor.unwindowed)),
            rms(errors(lapped)),
        )
        blocks = str(taylor.published.status.size)
        cells = [f"{100 * value:.2f}" for value in values]
        rows.append((f"{name} ({fine:g} / {coarse:g})", blocks, *cells))
    head = (
        "spacing of u (1 to 2 / elsewhere)",
        "blocks",
        "rms, Taylor",
        "largest",
        "rms where the stated sd is below 1 %",
        "jump without windows",
        "rms, lapped",
    )
    return Table(
        "Effect of spacing, in % of full scale. Blocks that are too small hold data in a corner "
        "only, and their stated standard deviation says so:",
        head,
        tuple(rows),
    )


def _largest(values: FloatArray) -> float:
    return float(np.abs(values).max())
