"""The tables that a controller has room for: by what they may miss, by size, on given axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtid.errors import RtidError
from rtid.estimator.flowmap import VALID, FlowMap
from rtid.estimator.validity import Doubt
from rtid.maps.files import TABLE_WRITERS, write_map
from rtid.maps.flashed import FlashedMap, of_edge
from rtid.maps.gridded import ERROR_SHARE, Tables, best_that_fits, gridded, on_nodes

COMPLETE = (".json", ".npz", ".csv")  # for programs that read what a map stands on


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


def write_release(path: Path, flowmap: FlowMap, origin: Mapping[str, Any], room: Room) -> Tables:
    """Write a map; the tables in it, none where its format has no plain ones.

    Raises RtidError where it has none and a room is asked for.
    """
    if room.is_asked:
        refuse_sized(path)
    tables = tables_for(flowmap, room) if _has_tables(path) else None
    write_map(path, flowmap, origin, tables)
    return tables or ()


def refuse_sized(path: Path) -> None:
    """RtidError for a format that holds no table whose size can be asked for."""
    if not _has_tables(path):
        remedy = (
            f"end its name in {', '.join(TABLE_WRITERS)}; a header's tables follow "
            "publish.error_percent of the project file"
        )
        raise RtidError(f"{path}: this format has no table of such a size", remedy, exit_code=2)


def _has_tables(path: Path) -> bool:
    return path.suffix.lower() in TABLE_WRITERS


def refuse_unfounded(
    source: str, suffix: str, invalid: Sequence[Doubt], flowmap: FlowMap, has_prior: bool = False
) -> None:
    """RtidError for maps that are impossible, or that know nothing."""
    if invalid:
        raise RtidError(
            f"{source}: not exported, {'; '.join(doubt.text for doubt in invalid)}",
            "`rtid export --force` writes it all the same",
            exit_code=4,
        )
    is_known = has_prior or any((edge.status == VALID).any() for edge in flowmap.edges)
    if not is_known and suffix.lower() not in COMPLETE:
        raise RtidError(
            f"{source}: not exported, no block of its maps stands on data",
            f"`rtid check` says what motion is missing; {', '.join(COMPLETE)} or --force write it",
            exit_code=4,
        )
