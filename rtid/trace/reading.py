"""A trace as complete samples: from a CAN log's frames, or from the rows of a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from firmware_bridge.assemble import Assembler
from firmware_bridge.catalog import Catalog
from firmware_bridge.config import Assembly
from firmware_bridge.frames import Frames, add_counts
from firmware_bridge.j1939 import Network, known_as
from firmware_bridge.samples import Samples, join
from firmware_bridge.sources import open_file, open_log
from firmware_bridge.sources.table import Table, to_samples
from rtid.errors import RtidError, door
from rtid.estimator.chunk import to_chunk
from rtid.estimator.noise import NoiseEstimate
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.project import Project
from rtid.trace.before_filter import noises_before
from rtid.trace.coarse import at_crossings
from rtid.trace.described import catalog_of
from rtid.trace.late_stamps import frames_in_time, rows_in_time
from rtid.trace.measured import with_sums
from rtid.trace.neutral import about_neutral
from rtid.trace.own_instants import of_log, of_table
from rtid.trace.repeated import REPEATED, where_sent
from rtid.trace.series import Series
from rtid.trace.spikes import without_spikes
from rtid.trace.table import declared

AT_ONCE = 1 << 17  # frames that are assembled in one go: each may become a sample
KEPT = 1 << 19  # frames that are few, 12 MB


class NoSamplesError(RtidError):
    """The trace holds nothing that the project can use; the text says what it does hold."""


class Log:
    """The frames of a log: kept where they are few, and read again where they are many."""

    def __init__(self, path: Path, frames: Frames) -> None:
        self._path, self._count = path, len(frames)
        self._kept = frames if len(frames) <= KEPT else None

    def __len__(self) -> int:
        return self._count

    def read(self) -> Frames:
        """All of them, in order of arrival; raises LogError where the file is there no longer."""
        return open_log(self._path) if self._kept is None else self._kept


@dataclass(frozen=True)
class Trace:
    """What a trace yields: complete samples, refusals by reason, and its log (None: a table).

    noise: of signals that have none declared, at the instants at which they were measured.
    crossed: signals whose rows are where they cross their steps (`coarse`); the `resolution` of
    their noise, which is known in any case, is what is left of the steps.
    """

    path: Path
    samples: Samples
    counters: dict[str, int]
    log: Log | None
    noise: Mapping[str, NoiseEstimate] = field(default_factory=dict)
    crossed: frozenset[str] = frozenset()

    @property
    def frames(self) -> Frames | None:
        """All frames of a log; None for a table."""
        return None if self.log is None else self.log.read()

    @property
    def duration_s(self) -> float:
        """From the first to the last sample."""
        return float(self.samples.t_us[-1] - self.samples.t_us[0]) * 1e-6

    def chunk(self, model: Machine) -> FloatArray:
        """All samples as the kernels take them (n, 2 + signals), SI; made once, not to be changed.

        [s since the first sample, flags, signals of the model].
        """
        names = tuple(signal.name for signal in model.signals)
        if names not in self._chunks:
            self._chunks[names] = to_chunk(model, self.samples, int(self.samples.t_us[0]))
        return self._chunks[names]

    @cached_property
    def _chunks(self) -> dict[tuple[str, ...], FloatArray]:
        return {}


@door
def read_trace(project: Project, path: str | Path) -> Trace:
    """All samples of a CAN log or a table.  Raises NoSamplesError, and the readers' errors."""
    path = Path(path)
    content = open_file(path)
    if isinstance(content, Table):
        table, assembly = declared(project, content)
        table, _ = rows_in_time(table, assembly)
        samples, counters = whole(project, *to_samples(table, assembly))
        samples = with_sums(project, about_neutral(project, samples))
        noise = noise_of(project, of_table(table, assembly))
        trace = _by_crossings(Trace(path, samples, counters, None, noise), project.model)
        return _not_empty(trace, project)
    catalog, assembly = catalog_of(project), project.assembly
    frames, _ = frames_in_time(content, assembly, catalog)
    samples, counters = whole(project, *assemble(catalog, assembly, frames))
    samples = with_sums(project, samples)
    noise = noise_of(project, of_log(frames, assembly, catalog))
    trace = Trace(path, samples, counters, Log(path, content), noise)
    trace = _not_empty(_by_crossings(trace, project.model), project)
    return _within_chunk(trace, project.model)


def _by_crossings(trace: Trace, model: Machine) -> Trace:
    """The trace with its rows where a coarse position crosses its steps."""
    samples, noise = at_crossings(model, trace.samples)
    if noise is None:
        return trace
    known = {**trace.noise, model.position: noise}
    return replace(trace, samples=samples, noise=known, crossed=frozenset({model.position}))


def noise_of(project: Project, series: Iterable[Series]) -> dict[str, NoiseEstimate]:
    """The noise of signals that have none declared, by name, in SI."""
    if not project.noise_unknown:  # then nothing need be decoded
        return {}
    asked = (s for s in series if s.name in project.noise_unknown)
    return {name: n.noise for name, n in noises_before(project.model, asked).items()}


def whole(
    project: Project, samples: Samples, counters: dict[str, int]
) -> tuple[Samples, dict[str, int]]:
    """The samples of a record that can be looked at as a whole: without those that spike.

    With rows where sensors are sent that the others repeat.
    """
    rest, spiked = without_spikes(project.model, samples)
    add_counts(counters, spiked)
    rest, repeats = where_sent(project.model, rest)
    add_counts(counters, {REPEATED: repeats})
    return rest, counters


def _within_chunk(trace: Trace, model: Machine) -> Trace:
    """The trace with the values of its samples where the kernels take them: nothing is kept twice.

    As it is where the model has other signals, or in another order.
    """
    if tuple(signal.name for signal in model.signals) != trace.samples.names:
        return trace
    chunk = trace.chunk(model)
    made = replace(trace, samples=replace(trace.samples, values=chunk[:, 2:]))
    vars(made)["_chunks"] = {trace.samples.names: chunk}
    return made


def assemble(
    catalog: Catalog, assembly: Assembly, frames: Frames
) -> tuple[Samples, dict[str, int]]:
    """Samples of a batch of frames, and the refusals by reason."""
    assembler = Assembler(catalog, assembly)
    matched = Network(catalog, assembly.messages).push(frames)
    _refuse_mixed(matched, catalog, assembly)
    parts = [*(assembler.push(part) for part in matched.chunks(AT_ONCE)), assembler.finish()]
    return join(parts), assembler.counters


def _refuse_mixed(frames: Frames, catalog: Catalog, assembly: Assembly) -> None:
    """RtidError for a message that comes on several channels where none is named."""
    for message in assembly.messages:
        mine = frames.channel[frames.can_id == known_as(catalog, message)]
        channels, counts = np.unique(mine, return_counts=True)
        if message.channel is None and len(channels) > 1:
            each = ", ".join(f"{c} ({n} frames)" for c, n in zip(channels, counts, strict=True))
            raise RtidError(
                f"{message.name} comes on several channels: {each}",
                f"name one, channel = {channels[counts.argmax()]} under [messages.{message.name}]; "
                f'another may be a message of its own, with of = "{message.name}"',
            )


def _not_empty(trace: Trace, project: Project) -> Trace:
    if len(trace.samples):
        return trace
    wanted = ", ".join(m.name for m in project.assembly.messages)
    if trace.log is None:
        raise NoSamplesError(f"{trace.path}: the table has no complete row")
    ids, counts = np.unique(trace.log.read().can_id & 0x7FFFFFFF, return_counts=True)
    common = ", ".join(f"0x{i:X} ({n})" for n, i in sorted(zip(counts, ids, strict=True))[:-6:-1])
    refused = ", ".join(f"{reason} {n}" for reason, n in trace.counters.items()) or "nothing"
    described = ", ".join(str(place.file) for place in project.databases)
    raise NoSamplesError(
        f"{trace.path}: no complete sample in {len(trace.log)} frames. "
        f"Wanted: {wanted}. Refused: {refused}. Most frequent ids: {common or 'none'}",
        f"does {described} describe this bus? `rtid check` shows what the trace holds",
    )
