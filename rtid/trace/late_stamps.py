"""Records whose rows or messages are stamped late by turns, put back to when they were sampled.

On board a frame acts when it comes, whatever its stamp: this is of records alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from firmware_bridge.catalog import Catalog
from firmware_bridge.config import Assembly
from firmware_bridge.frames import Frames, by_time
from firmware_bridge.j1939 import Network
from firmware_bridge.sources.table import TIME_UNITS, Table, in_turn
from rtid.plain import IntArray
from rtid.trace.own_instants import are_of, of_message
from rtid.trace.steady import SeenMoving, SteadyGrid, grid_of, joined, seen_moving


def rows_in_time(table: Table, assembly: Assembly) -> tuple[Table, float]:
    """A table with its rows at the instants at which they were sampled; how much they jitter, s.

    As it is, and 0, where its stamps are even, where its sensors do not tell that they were sampled
    evenly, and where rows tell them in turn.
    """
    sensors = [s for s in assembly.signals if s.constant is None and not s.command]
    columns = [table.column(s.signal) for s in sensors]
    grid = None if any(len(in_turn(c)) for c in columns) else grid_of(table.t_us())
    if grid is None or not seen_moving(grid, columns).says_grid:
        return table, 0.0
    name = table.time_name()
    assert name is not None, "its stamps have been read"
    factor = TIME_UNITS[table.time_unit(name).lower()]
    return replace(table, columns=table.columns | {name: 1e-6 * grid.t_us / factor}), grid.jitter_s


def frames_in_time(frames: Frames, assembly: Assembly, catalog: Catalog) -> tuple[Frames, float]:
    """Frames with the stamps of steady messages at the instants of their senders; jitter, s.

    A message of commands alone tells nothing itself: one clock has stamped all, and what the
    messages of the sensors say together goes for it too.  Where one of them surely was sampled at
    its stamps, all keep theirs, and so do those of J1939.
    """
    if Network(catalog, assembly.messages).is_needed:
        return frames, 0.0
    places = {m.name: np.flatnonzero(are_of(frames, m, catalog)) for m in assembly.messages}
    grids = {n: g for n, at in places.items() if (g := grid_of(frames.t_us[at])) is not None}
    told = _told(frames, assembly, catalog, grids, places)
    if any(part.says_stamps for part in told) or not joined(told).says_grid:
        return frames, 0.0
    t_us = frames.t_us.copy()
    for name, grid in grids.items():
        t_us[places[name]] = np.rint(grid.t_us)
    return by_time(replace(frames, t_us=t_us)), max(grid.jitter_s for grid in grids.values())


def _told(
    frames: Frames,
    assembly: Assembly,
    catalog: Catalog,
    grids: Mapping[str, SteadyGrid],
    places: Mapping[str, IntArray],
) -> list[SeenMoving]:
    """What the sensors of each message say that has a grid."""
    commands = {s.name for s in assembly.signals if s.command}
    told = []
    for message in assembly.messages:
        if message.name in grids:
            series = of_message(frames[places[message.name]], message, assembly, catalog)
            sensors = [s.value for s in series if s.name not in commands]
            told.append(seen_moving(grids[message.name], sensors))
    return told
