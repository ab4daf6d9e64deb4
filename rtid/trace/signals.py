"""Read a trace for judging: every signal at its own instants, and the samples that they make."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_bridge.catalog import Catalog
from firmware_bridge.config import Assembly
from firmware_bridge.frames import Frames
from firmware_bridge.samples import Samples
from firmware_bridge.sources import open_file
from firmware_bridge.sources.table import Table, to_samples
from rtid.errors import RtidError
from rtid.project import Project
from rtid.trace.arrivals import Timing, timing
from rtid.trace.described import catalog_of
from rtid.trace.late_stamps import frames_in_time, rows_in_time
from rtid.trace.measured import with_sums
from rtid.trace.neutral import about_neutral
from rtid.trace.own_instants import of_messages, of_table, wanted
from rtid.trace.reading import assemble, whole
from rtid.trace.series import Series
from rtid.trace.table import declared


@dataclass(frozen=True)
class Recording:
    """A trace as declared: raw series per signal, timing per message, complete samples.

    A table has one "message", called after its file.  `refused` counts by reason.  jitter_s: of
    stamps that were put back to the instants of a steady sender (`late_stamps`), rms; 0 of others.
    """

    path: Path
    series: tuple[Series, ...]
    messages: dict[str, Timing]
    samples: Samples
    refused: dict[str, int]
    is_table: bool
    jitter_s: float = 0.0


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
    table, jitter_s = rows_in_time(table, assembly)
    samples, refused = whole(project, *to_samples(table, assembly))
    samples = with_sums(project, about_neutral(project, samples))
    messages = {table.path.name: timing(table.t_us())}
    series = tuple(of_table(table, assembly))
    return Recording(table.path, series, messages, samples, refused, True, jitter_s)


def _from_log(project: Project, path: Path, frames: Frames) -> Recording:
    catalog, assembly = catalog_of(project), project.assembly
    chosen = wanted(frames, assembly, catalog)
    if not any(len(frames) for frames in chosen.values()):
        raise RtidError(*_nothing_wanted(path, frames, assembly, catalog))
    frames, jitter_s = frames_in_time(frames, assembly, catalog)
    chosen = wanted(frames, assembly, catalog) if jitter_s else chosen
    series = of_messages(chosen, assembly, catalog)
    samples, refused = whole(project, *assemble(catalog, assembly, frames))
    samples = with_sums(project, samples)
    timings = {name: timing(frames.t_us) for name, frames in chosen.items()}
    return Recording(path, tuple(series), timings, samples, refused, False, jitter_s)


def _nothing_wanted(
    path: Path, frames: Frames, assembly: Assembly, catalog: Catalog
) -> tuple[str, str]:
    """Message and remedy for a log without any frame that the project asks for."""
    ids = [f"{m.name} 0x{catalog.can_id(m.name) & 0x1FFFFFFF:X}" for m in assembly.messages]
    seen = sorted({int(i) & 0x1FFFFFFF for i in np.unique(frames.can_id)})
    shown = ", ".join(f"0x{i:X}" for i in seen[:8]) + (", ..." if len(seen) > 8 else "")
    text = f"{path}: none of {len(frames)} frames is wanted ({', '.join(ids)})"
    return text, f"the log holds {shown or 'nothing'}: is it the right DBC, channel and log?"
