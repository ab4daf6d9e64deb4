"""Every signal of a record at the instants at which it was measured, in SI units.

What samples hold of a message that came between two others is on the line between its values: its
noise is less there, and next to none at the rate of the samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from firmware_bridge.catalog import Catalog
from firmware_bridge.config import Assembly, MessageSource, SignalSource
from firmware_bridge.frames import Frames
from firmware_bridge.j1939 import Network, known_as
from firmware_bridge.sources.table import Table, in_turn
from rtid.plain import BoolArray, FloatArray, IntArray
from rtid.trace.series import Series


def of_table(table: Table, assembly: Assembly) -> Iterator[Series]:
    """Those of the columns of a table that is declared."""
    t_us = table.t_us()
    for source in assembly.signals:
        if source.constant is None:
            yield _of_column(source, t_us, table.column(source.signal))


def of_log(frames: Frames, assembly: Assembly, catalog: Catalog) -> Iterator[Series]:
    """Those of the frames of a log."""
    yield from of_messages(wanted(frames, assembly, catalog), assembly, catalog)


def of_messages(
    chosen: Mapping[str, Frames], assembly: Assembly, catalog: Catalog
) -> Iterator[Series]:
    """Those of the frames of each message, as from `wanted`."""
    for message in assembly.messages:
        yield from of_message(chosen[message.name], message, assembly, catalog)


def wanted(frames: Frames, assembly: Assembly, catalog: Catalog) -> dict[str, Frames]:
    """The frames of each message that is asked for."""
    matched = Network(catalog, assembly.messages).push(frames)
    return {m.name: matched[are_of(matched, m, catalog)] for m in assembly.messages}


def _of_column(source: SignalSource, t_us: IntArray, column: FloatArray) -> Series:
    """A column (n,), unit of the file; of one told in turn with others what is written."""
    known = in_turn(column)
    at = known if len(known) else slice(None)
    return Series(source.name, t_us[at], _si(column[at], source))


def are_of(frames: Frames, message: MessageSource, catalog: Catalog) -> BoolArray:
    """Which of the frames, (n,), are those of a message, matched where it is one of J1939."""
    mine = frames.can_id == known_as(catalog, message)
    if message.channel is not None:
        mine &= frames.channel == message.channel
    return np.asarray(mine & (frames.length == catalog.message(message.name).length))


def of_message(
    frames: Frames, message: MessageSource, assembly: Assembly, catalog: Catalog
) -> list[Series]:
    """The signals that are asked for in the frames of one message."""
    sources = [s for s in assembly.signals if s.message == message.name and s.constant is None]
    layouts = catalog.layouts(message.name, list(dict.fromkeys(s.signal for s in sources)))
    values = layouts.decode(frames.data)
    columns = {name: values[:, k] for k, name in enumerate(layouts.names)}
    return [Series(s.name, frames.t_us, _si(columns[s.signal], s)) for s in sources]


def _si(value: FloatArray, source: SignalSource) -> FloatArray:
    if source.table is not None:
        return np.interp(value, *source.table)
    return source.factor * value + source.offset
