"""Fig. 1 and 4: how the plane of command and pressure drop is cut, and where the data lie."""

from __future__ import annotations

import numpy as np

from benchmarks.paper.learning import Learned, learn
from benchmarks.paper.result import Measure, Part, Table, at_most
from rtid.estimator.flowmap import VALID
from rtid.model import Grid
from rtid.sim.boom import boom, grid
from rtid.tell.charts.coverage import coverage
from rtid.tell.charts.points import working_points

NEAR_V = (1.0, 4.0)  # where the dead band may end
EVERY = 20  # samples between two points at which maps are compared


def reproduce(seed: int = 0) -> Part:
    """Fig. 1 and 4 with their numbers, and the same with equal spacing."""
    unequal, equal = (learn(boom(), seed, blocks=blocks) for blocks in (grid(), even()))
    shares = [_share(learned) for learned in (unequal, equal)]
    errors = [near_error(learned) for learned in (unequal, equal)]
    text = (
        "The boom sweeps 0.1 to 0.5 Hz for 80 s. Blocks are 0.25 V wide from 1 to 4 V, where the "
        "dead band may end, 0.5 V above, and 0.5 MPa high; for comparison as many of equal "
        "width. The data fill a part of the plane only; the rest is left to the orifice law. "
        "Errors are taken at the working points of 1 to 4 V in valid blocks, as shares of the "
        "largest flow."
    )
    measures = (
        Measure("blocks of four valves", float(shares[0][0])),
        Measure("visited", 100 * shares[0][1], "%"),
        Measure("valid among those visited", 100 * shares[0][2], "%"),
        Measure("working points in valid blocks", 100 * shares[0][3], "%"),
        at_most("rms error from 1 to 4 V", 100 * errors[0], 0.5, "%"),
        at_most("ratio to equal spacing", errors[0] / errors[1], 1.0),
    )
    picture = coverage(unequal.model, unequal.flowmap, unequal.replay.chunk)
    for line in (line for axis in picture.axes for line in axis.lines):
        line.set_rasterized(True)  # thousands of points would fill an SVG
    title = "Fig. 1 and 4: blocks and location of the data"
    return Part("fig4", title, text, measures, (_table(unequal, equal),), {"fig4": picture})


def even() -> Grid:
    """As many blocks as `grid()`, of equal width along the command."""
    unequal = grid()
    u = unequal.u_v
    return Grid(np.linspace(u[0], u[-1], len(u)), unequal.dp_pa)


def near_error(learned_map: Learned) -> float:
    """Root mean square error at the working points from 1 to 4 V, share of the largest flow."""
    squares = []
    for edge, learned in zip(learned_map.model.edges, learned_map.flowmap.edges, strict=True):
        w, dp = (
            a[::EVERY] for a in working_points(learned_map.model, edge, learned_map.replay.chunk)
        )
        here = (w > NEAR_V[0]) & (w < NEAR_V[1]) & (learned.status_at(w, dp) == VALID)
        miss = learned.flow(w[here], dp[here]) - learned_map.plant.flow(
            edge.name, w[here], dp[here]
        )
        squares.append((miss / learned.q_max_m3s) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _share(learned_map: Learned) -> tuple[int, float, float, float]:
    """Blocks; share visited; of those, share valid; share of the working points in valid ones."""
    cells = sum(edge.status.size for edge in learned_map.flowmap.edges)
    visited = len(learned_map.replay.fit.solution.blocks)
    valid = sum(int((edge.status == VALID).sum()) for edge in learned_map.flowmap.edges)
    inside = []
    for edge, learned in zip(learned_map.model.edges, learned_map.flowmap.edges, strict=True):
        points = working_points(learned_map.model, edge, learned_map.replay.chunk)
        inside.append(learned.status_at(*points) == VALID)
    return cells, visited / cells, valid / visited, float(np.mean(np.concatenate(inside)))


def _table(unequal: Learned, equal: Learned) -> Table:
    rows = []
    for name, learned in (("unequal, fine from 1 to 4 V", unequal), ("equal", equal)):
        cells, *shares = _share(learned)
        values = (*shares, near_error(learned))
        rows.append((name, str(cells), *(f"{100 * v:.3g} %" for v in values)))
    head = ("spacing", "blocks", "visited", "of these valid", "points in valid", "rms error, 1-4 V")
    return Table("Spacing:", head, tuple(rows))
