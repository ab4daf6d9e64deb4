"""Read a trace for judging: every signal at its own instants, and the samples that they make."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_bridge.catalog import Catalog
from firmware_bridge.config import Assembly, MessageSource, SignalSource
from firmware_bridge.frames import Frames
from firmware_bridge.j1939 import Network, known_as
from firmware_bridge.samples import Samples
from firmware_bridge.sources import open_file
from firmware_bridge.sources.table import Table, in_turn, to_samples
from rtid.errors import RtidError
from rtid.plain import FloatArray, IntArray
from rtid.project import Project
from rtid.trace.arrivals import Timing, timing
from rtid.trace.described import catalog_of
from rtid.trace.measured import with_sums
from rtid.trace.neutral import about_neutral
from rtid.trace.reading import assemble, whole
from rtid.trace.series import Series
from rtid.trace.table import declared


@dataclass(frozen=True)
class Recording:
    """A trace as declared: raw series per signal, timing per message, complete samples.

    A table has one "message", called after its file.  `refused` counts by reason.
    """

    path: Path
    series: tuple[Series, ...]
    messages: dict[str, Timing]
    samples: Samples
    refused: dict[str, int]
    is_table: bool


def read_recording(project: Project, path: Path) -> Recording:
    """Read a CAN log or a table; RtidError if it holds nothing wanted, or the readers' errors."""
    content = open_file(path)
    if isinstance(content, Table):
        return _from_table(project, content)
    return _from_log(project, path, content)


def series_of(by_name: dict[str, Frames], catalog: Catalog) -> Iterator[tuple[str, Series]]:
    """Unit and values, in this unit, of every signal in the frames of the messages of a catalog."""
    for name, mine in by_name.items():
        layouts = catalog.layouts(name)
        values = layouts.decode(mine.data)
        for k, signal in enumerate(layouts.names if len(mine) else ()):
            unit = catalog.signal(name, signal).unit or ""
            yield unit, Series(f"{name}.{signal}", mine.t_us, values[:, k])


def _from_table(project: Project, content: Table) -> Recording:
    table, assembly = declared(project, content)
    samples, refused = whole(project, *to_samples(table, assembly))
    samples = with_sums(project, about_neutral(project, samples))
    t_us = table.t_us()
    series = tuple(
        _of_column(source, t_us, table.column(source.signal))
        for source in assembly.signals
        if source.constant is None
    )
    messages = {table.path.name: timing(t_us)}
    return Recording(table.path, series, messages, samples, refused, True)


def _of_column(source: SignalSource, t_us: IntArray, column: FloatArray) -> Series:
    """A column (n,), unit of the file; of one told in turn with others what is written."""
    known = in_turn(column)
    at = known if len(known) else slice(None)
    return Series(source.name, t_us[at], _si(column[at], source))


def _from_log(project: Project, path: Path, frames: Frames) -> Recording:
    catalog, assembly = catalog_of(project), project.assembly
    matched = Network(catalog, assembly.messages).push(frames)
    chosen = {m.name: _frames_of(matched, m, catalog) for m in assembly.messages}
    if not any(len(frames) for frames in chosen.values()):
        raise RtidError(*_nothing_wanted(path, frames, assembly, catalog))
    series = [s for m in assembly.messages for s in _series(chosen[m.name], m, assembly, catalog)]
    samples, refused = whole(project, *assemble(catalog, assembly, frames))
    samples = with_sums(project, samples)
    timings = {name: timing(frames.t_us) for name, frames in chosen.items()}
    return Recording(path, tuple(series), timings, samples, refused, False)


def _frames_of(frames: Frames, message: MessageSource, catalog: Catalog) -> Frames:
    wanted = frames.can_id == known_as(catalog, message)
    if message.channel is not None:
        wanted &= frames.channel == message.channel
    return frames[wanted & (frames.length == catalog.message(message.name).length)]


def _series(
    frames: Frames, message: MessageSource, assembly: Assembly, catalog: Catalog
) -> list[Series]:
    sources = [s for s in assembly.signals if s.message == message.name and s.constant is None]
    layouts = catalog.layouts(message.name, list(dict.fromkeys(s.signal for s in sources)))
    values = layouts.decode(frames.data)
    columns = {name: values[:, k] for k, name in enumerate(layouts.names)}
    return [Series(s.name, frames.t_us, _si(columns[s.signal], s)) for s in sources]


def _si(value: FloatArray, source: SignalSource) -> FloatArray:
    if source.table is not None:
        return np.interp(value, *source.table)
    return source.factor * value + source.offset


def _nothing_wanted(
    path: Path, frames: Frames, assembly: Assembly, catalog: Catalog
) -> tuple[str, str]:
    """Message and remedy for a log without any frame that the project asks for."""
    ids = [f"{m.name} 0x{catalog.can_id(m.name) & 0x1FFFFFFF:X}" for m in assembly.messages]
    seen = sorted({int(i) & 0x1FFFFFFF for i in np.unique(frames.can_id)})
    shown = ", ".join(f"0x{i:X}" for i in seen[:8]) + (", ..." if len(seen) > 8 else "")
    text = f"{path}: none of {len(frames)} frames is wanted ({', '.join(ids)})"
    return text, f"the log holds {shown or 'nothing'}: is it the right DBC, channel and log?"
