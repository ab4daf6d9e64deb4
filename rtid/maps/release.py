"""The tables that a controller has room for: by what they may miss, by size, on given axes."""

from __future__ import annotations

from dataclasses import dataclass

from rtid.errors import RtidError
from rtid.estimator.flowmap import FlowMap
from rtid.maps.flashed import FlashedMap, of_edge
from rtid.maps.gridded import ERROR_SHARE, Tables, best_that_fits, gridded, on_nodes


@dataclass(frozen=True)
class Room:
    """What is asked of the tables, one of them; None: not asked.

    share: of the largest flow that a table may miss by; nodes: at most so many commands and drops
    per edge; n_bytes: all flows and axes as 16-bit numbers; axes: those of maps that are there.
    """

    share: float | None = None
    nodes: tuple[int, int] | None = None
    n_bytes: int | None = None
    axes: tuple[FlashedMap, ...] = ()

    @property
    def is_asked(self) -> bool:
        """Whether anything is."""
        return bool(self.axes) or any(x is not None for x in (self.share, self.nodes, self.n_bytes))


def tables_for(flowmap: FlowMap, room: Room) -> Tables:
    """The tables of a map.  Raises RtidError where they do not fit, or two things are asked."""
    asked = [x for x in (room.share, room.nodes, room.n_bytes) if x is not None]
    if len(asked) + bool(room.axes) > 1:
        raise RtidError(
            "axes, tolerance, nodes and bytes are each enough to fix a table", "give one", 2
        )
    if room.axes:
        pairs = [(edge, of_edge(room.axes, edge.name)) for edge in flowmap.edges]
        return tuple(on_nodes(edge, m.u_v, m.dp_pa) for edge, m in pairs)
    if room.nodes is not None:
        nu, nd = room.nodes
        alone = (FlowMap((edge,)) for edge in flowmap.edges)
        return tuple(
            best_that_fits(one, lambda t: len(t[0].u_v) <= nu and len(t[0].dp_pa) <= nd)[0]
            for one in alone
        )
    if room.n_bytes is not None:
        most = room.n_bytes
        return best_that_fits(flowmap, lambda tables: sum(g.n_bytes for g in tables) <= most)
    return gridded(flowmap, room.share or ERROR_SHARE)
