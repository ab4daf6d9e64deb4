"""What the status says of the maps: blocks and cells of each edge by what is known of them."""

from __future__ import annotations

from collections import Counter

from rtid.daemon.status import BlockPlane, EdgeHealth
from rtid.estimator.estimator import Estimator
from rtid.estimator.flowmap import LEARNING, VALID, EdgeMap, FlowMap
from rtid.estimator.solution import Solution
from rtid.model import Edge


def edges_of(estimator: Estimator, solution: Solution, flow_map: FlowMap) -> tuple[EdgeHealth, ...]:
    """Blocks and cells of each edge by status."""
    edge_health = []
    for i, edge in enumerate(estimator.model.edges):
        mine = [block for block in solution.blocks if block.edge == i]
        cells = Counter(str(status) for status in flow_map.edges[i].status.ravel())
        progress = sum(block.progress for block in mine) / max(1, len(mine))
        blocks = Counter(block.status for block in mine)
        plane = plane_of(edge, flow_map.edges[i])
        edge_health.append(EdgeHealth(edge.name, dict(blocks), dict(cells), progress, plane))
    return tuple(edge_health)


def plane_of(edge: Edge, learned: EdgeMap) -> BlockPlane | None:
    """What became of every block of a map; None of one over no pressure drop."""
    if not (edge.source and edge.sink):
        return None
    letters = {VALID: "v", LEARNING: "l"}
    codes = "".join(letters.get(str(word), ".") for word in learned.status.ravel())
    ends = tuple(learned.grid.u_v.tolist()), tuple(learned.grid.dp_pa.tolist())
    return BlockPlane(*ends, codes, edge.command, edge.source, edge.sink, int(edge.direction))
