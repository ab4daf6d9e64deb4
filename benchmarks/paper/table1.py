"""Table 1: the estimated map of a valve beside the individually calibrated one.

The calibration is the simulator's own flow, which nothing that learns has seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.learning import Learned, learn
from benchmarks.paper.result import Measure, Part, Table, at_least, at_most
from rtid.compare.tables import PAPER_DP_PA, PAPER_U_V
from rtid.estimator.cells import quadrature, terms
from rtid.estimator.flowmap import VALID
from rtid.plain import FloatArray
from rtid.sim.boom import boom
from rtid.sim.run import SimulationError
from rtid.units import LPM, MPA

NOT_GIVEN = np.nan
# Table 1 of the paper in L/min, rows by pressure drop, columns by command.
PAPER_ESTIMATED = (
    (7.33, 12.02, 17.79, 22.96),
    (8.20, 12.44, 17.37, 22.62),
    (7.98, 12.02, NOT_GIVEN, NOT_GIVEN),
)
PAPER_CALIBRATED = (
    (8.00, 11.83, 17.57, 22.60),
    (8.00, 12.22, 17.18, 21.95),
    (7.97, 12.00, 16.39, 20.61),
)
PAPER_CELLS = 10 / 12  # share of its table for which the paper gives an estimate
EDGE = "pa"  # the valve of the table
LEAST_V = 4.0  # commands from here on count for the error: as in the table
THRESHOLDS = (1e2, 1e3, 1e4, 1e5, 1e6, 1e8, np.inf)
MACHINES = 6  # random machines at the most
Z95 = 1.96


@dataclass(frozen=True)
class Cells:
    """Learned and true flow at points (n,), m3/s; sd: stated; valid: the point stands on data."""

    flow: FloatArray
    sd: FloatArray
    true: FloatArray
    valid: NDArray[np.bool_]

    @property
    def error(self) -> FloatArray:
        """|learned - true| as shares of the true flow (n,)."""
        return np.asarray(np.abs(self.flow / self.true - 1.0))

    @property
    def score(self) -> float:
        """Root mean square of the error in stated standard deviations; 1: just as stated."""
        return float(np.sqrt(np.mean(((self.flow - self.true) / self.sd) ** 2)))

    @property
    def covered(self) -> FloatArray:
        """1 where the 95 % interval holds the truth (n,)."""
        return np.asarray(np.abs(self.flow - self.true) <= Z95 * self.sd, float)


def table_cells(learned: Learned, edge: str = EDGE) -> Cells:
    """The twelve points of Table 1, pressure by pressure."""
    dp, w = (a.ravel() for a in np.meshgrid(PAPER_DP_PA, PAPER_U_V, indexing="ij"))
    return _cells(learned, edge, w, dp)


def nodes(learned: Learned) -> Cells:
    """All corners between four valid blocks at commands as in the table, of all edges."""
    parts = []
    for edge in learned.flowmap.edges:
        s = edge.status == VALID
        i, j = np.nonzero(s[1:, 1:] & s[:-1, 1:] & s[1:, :-1] & s[:-1, :-1])
        w, dp = edge.grid.u_v[i + 1], edge.grid.dp_pa[j + 1]
        parts.append(_cells(learned, edge.name, w[w >= LEAST_V], dp[w >= LEAST_V]))
    return joined(parts)


def joined(parts: Sequence[Cells]) -> Cells:
    """All points one after the other."""
    columns = (np.concatenate([getattr(p, name) for p in parts]) for name in Cells.__annotations__)
    return Cells(*columns)


def _cells(learned_map: Learned, edge: str, w: FloatArray, dp: FloatArray) -> Cells:
    learned = learned_map.flowmap[edge]
    valid = learned.status_at(w, dp) == VALID
    true = learned_map.plant.flow(edge, w, dp)
    return Cells(learned.flow(w, dp), learned.sd(w, dp), true, valid)


@dataclass(frozen=True)
class BlockErrors:
    """Per visited block (n,): condition number; rms errors over the block.

    Shares of the edge's largest flow; own: of its own terms alone, published: of the map.
    """

    condition: FloatArray
    own: FloatArray
    published: FloatArray


def block_errors(learned: Learned) -> BlockErrors:
    """Every block with enough rows, above the safe band."""
    rows, phi = [], terms()
    model, gates = learned.model, learned.model.gates
    for b in learned.replay.fit.solution.blocks:
        edge = model.edges[b.edge]
        if b.rows < gates.min_rows or edge.grid.u_v[b.i + 1] <= edge.safe_band_v:
            continue
        w, dp = (a[b.j] for a in quadrature(edge.grid, b.i))
        true = learned.plant.flow(edge.name, w, dp)
        largest = learned.flowmap[edge.name].q_max_m3s
        misses = phi @ b.theta - true, learned.flowmap[edge.name].flow(w, dp) - true
        rows.append([b.condition, *(np.sqrt(np.mean(m**2)) / largest for m in misses)])
    return BlockErrors(*np.array(rows).T)


def reproduce(seed: int = 0, plants: int = MACHINES) -> Part:
    """Table 1 with its numbers."""
    learned = learn(boom(), seed)
    cells, limit = table_cells(learned), learned.model.gates.condition_limit
    others = joined([nodes(learned), *random_nodes(min(plants, MACHINES))])
    text = (
        "The boom sweeps 0.1 to 0.5 Hz for 80 s; its frames are replayed with blocks as in Fig. 4 "
        f"and a condition threshold of {limit:.0e}. The calibrated map is the simulator's own. "
        "Errors are shares of the calibrated flow at the same point. The last lines count "
        "every corner between four valid blocks at 4 V and more, of four valves each, on this "
        f"boom and {min(plants, MACHINES)} random ones."
    )
    measures = (
        at_most("mean error in the table", 100 * cells.error.mean(), 0.5, "%", "2.2 %"),
        at_most("largest error in the table", 100 * cells.error.max(), 1.5, "%", "8.4 %"),
        at_least("cells on data", 100 * cells.valid.mean(), 100 * PAPER_CELLS, "%", "83 %"),
        at_most("mean error, all corners", 100 * others.error.mean(), 0.5, "%"),
        at_most("largest error, all corners", 100 * others.error.max(), 1.5, "%"),
        at_least("truth within the 95 % interval", 100 * others.covered.mean(), 93.0, "%"),
        Measure("rms error in stated standard deviations", others.score),
        Measure("corners", len(others.error)),
    )
    tables = (_table(cells), _threshold_table(block_errors(learned), limit))
    return Part("table1", "Table 1: estimated against calibrated map", text, measures, tables)


def random_nodes(machines: int, first: int = 100) -> list[Cells]:
    """`nodes` of so many random machines; one that cannot follow the sweep is left out."""
    cellses: list[Cells] = []
    number = first
    while len(cellses) < machines:
        with suppress(SimulationError):  # leaves its stroke: nobody would sweep it so
            cellses.append(nodes(learn(boom(number), number)))
        number += 1
    return cellses


def _table(cells: Cells) -> Table:
    """As in the paper: estimate / calibrated; with * where it is extrapolated."""
    shape = len(PAPER_DP_PA), len(PAPER_U_V)
    q, true, valid = (a.reshape(shape) for a in (cells.flow * LPM, cells.true * LPM, cells.valid))
    rows = []
    for k, dp in enumerate(PAPER_DP_PA):
        ours = [
            f"{q[k, i]:.2f}{'' if valid[k, i] else '*'} / {true[k, i]:.2f}" for i in range(shape[1])
        ]
        pairs = zip(PAPER_ESTIMATED[k], PAPER_CALIBRATED[k], strict=True)
        theirs = [f"{e:.2f} / {c:.2f}" if np.isfinite(e) else f"NA / {c:.2f}" for e, c in pairs]
        rows += [(f"{dp * MPA:g} MPa", *ours), ("paper", *theirs)]
    title = "Estimated / calibrated flow in L/min, * extrapolated; the paper's valve below:"
    return Table(title, ("", *(f"{u:g} V" for u in PAPER_U_V)), tuple(rows))


def _threshold_table(blocks: BlockErrors, used: float) -> Table:
    rows = []
    for limit in THRESHOLDS:
        below = blocks.condition <= limit
        block_error, published = blocks.own[below], blocks.published[below]
        cells = [f"{100 * f(e):.3g}" for e in (block_error, published) for f in (np.median, np.max)]
        name = "none" if np.isinf(limit) else f"{limit:.0e}"
        rows.append((name + (" (used)" if limit == used else ""), str(below.sum()), *cells))
    head = ("threshold", "blocks below", "own terms, median", "worst", "published, median", "worst")
    title = (
        "What changes with the threshold: rms error over each block, % of the largest flow, of "
        "its own six terms and of the published map, which combines them with the orifice law:"
    )
    return Table(title, head, tuple(rows))
