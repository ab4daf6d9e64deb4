"""Replay: a captured trace through the same path as on board, then the record path on top.

frames -> Assembler -> Samples -> Estimator (nominal weights, whole trace: what the daemon has), and
`fit_record` on the identification part (refined weights, lag and message offsets as nuisances).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from firmware_bridge.assemble import Assembler
from firmware_bridge.catalog import Catalog
from firmware_bridge.config import Assembly
from firmware_bridge.frames import Frames
from firmware_bridge.samples import Samples
from firmware_bridge.sources import open_log
from firmware_bridge.sources.table import to_samples
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator, to_chunk
from rtid.estimator.noise import estimate_noise
from rtid.estimator.record import RecordFit, fit_record
from rtid.live import Learner, catalog_of, listen, virtual_bus
from rtid.model import FloatArray, Model, Signal
from rtid.project import Project
from rtid.project.table import is_table, open_table

if TYPE_CHECKING:
    from rtid.compare.beside import KnownEffect

Progress = Callable[[str, float], None]


def _silent(text: str, share: float) -> None:
    """Progress that nobody watches."""


class NoSamplesError(RtidError):
    """The trace holds nothing that the project can use; the text says what it does hold."""


@dataclass(frozen=True)
class Trace:
    """What a trace yields: complete samples, refusals by reason, and the frames (None: a table)."""

    path: Path
    samples: Samples
    counters: dict[str, int]
    frames: Frames | None

    @property
    def duration_s(self) -> float:
        """From the first to the last sample."""
        return float(self.samples.t_us[-1] - self.samples.t_us[0]) * 1e-6


@dataclass(frozen=True)
class Replay:
    """A replayed trace: `live` is what the daemon would have learned, `fit` the record path.

    added: effects of the model beside which `fit` was learned (`rtid.beside`); then model and chunk
    are those of the machine with them.
    """

    project: Project
    model: Model
    trace: Trace
    live: Estimator
    fit: RecordFit
    chunk: FloatArray
    identification_s: tuple[float, float]
    validation_s: tuple[float, float] | None
    added: tuple[KnownEffect, ...] = ()

    def part(self, span_s: tuple[float, float]) -> FloatArray:
        """Rows of the chunk with span_s[0] <= t < span_s[1], seconds from the first sample."""
        t_s = self.chunk[:, 0]
        return self.chunk[(t_s >= span_s[0]) & (t_s < span_s[1])]


def read_trace(project: Project, path: Path) -> Trace:
    """All samples of a CAN log or a table.  Raises NoSamplesError, and the readers' errors."""
    if is_table(path) and project.table_assembly is not None:
        samples, counters = to_samples(open_table(project, path), project.table_assembly)
        return _not_empty(Trace(path, samples, counters, None), project)
    frames = open_log(path)
    samples, counters = assemble(catalog_of(project), project.assembly, frames)
    return _not_empty(Trace(path, samples, counters, frames), project)


def assemble(
    catalog: Catalog, assembly: Assembly, frames: Frames
) -> tuple[Samples, dict[str, int]]:
    """Samples of a batch of frames, and the refusals by reason."""
    assembler = Assembler(catalog, assembly)
    parts = [assembler.push(frames), assembler.finish()]
    return join(parts), assembler.counters


def join(parts: list[Samples]) -> Samples:
    """Runs of samples, one after the other."""
    return Samples(
        parts[0].names,
        np.concatenate([p.t_us for p in parts]),
        np.concatenate([p.values for p in parts]),
        np.concatenate([p.flags for p in parts]),
    )


def _not_empty(trace: Trace, project: Project) -> Trace:
    if len(trace.samples):
        return trace
    wanted = ", ".join(m.name for m in project.assembly.messages)
    if trace.frames is None:
        raise NoSamplesError(f"{trace.path}: the table has no complete row")
    ids, counts = np.unique(trace.frames.can_id & 0x7FFFFFFF, return_counts=True)
    common = ", ".join(f"0x{i:X} ({n})" for n, i in sorted(zip(counts, ids, strict=True))[:-6:-1])
    refused = ", ".join(f"{reason} {n}" for reason, n in trace.counters.items()) or "nothing"
    raise NoSamplesError(
        f"{trace.path}: no complete sample in {len(trace.frames)} frames. "
        f"Wanted: {wanted}. Refused: {refused}. Most frequent ids: {common or 'none'}",
        f"does {project.dbc} describe this bus? `rtid check` shows what the trace holds",
    )


def replay(
    project: Project, path: Path, progress: Progress = _silent, bus_speed: float | None = None
) -> Replay:
    """Everything that one trace tells.

    progress is told what is being done and the share that is done, 0 to 1.  bus_speed: send the
    frames through a virtual bus at so many times their pace (inf: at once) instead of taking them
    from the file; the result is the same, bit for bit.
    """
    progress("reading", 0.0)
    trace = read_trace(project, path)
    model = model_for(project, trace.samples)
    progress("learning as on board", 0.2)
    if bus_speed is None:
        live = _as_on_board(project, model, trace)
    else:
        live = _through_bus(project, model, trace, bus_speed, progress)
    progress("refining weights, lag and offsets", 0.5)
    span = project.sections.record.identification_s or (0.0, np.inf)
    fit, trace = _fit(project, model, trace, span)
    progress("done", 1.0)
    chunk = to_chunk(model, trace.samples, int(trace.samples.t_us[0]))
    validation = project.sections.record.validation_s
    return Replay(project, model, trace, live, fit, chunk, span, validation)


def _as_on_board(project: Project, model: Model, trace: Trace) -> Estimator:
    """The estimate from the frames, through the gates of the daemon; a table has passed its own."""
    if trace.frames is None:
        live = Estimator(model)
        live.update(trace.samples)
        return live
    learner = Learner(model, catalog_of(project), project.assembly)
    learner.push(trace.frames)
    learner.finish()
    return learner.estimator


def _through_bus(
    project: Project, model: Model, trace: Trace, speed: float, progress: Progress
) -> Estimator:
    """The estimate from the same frames, sent over a virtual bus."""
    if trace.frames is None:
        raise RtidError(f"{trace.path}: a table has no frames for a bus", "give a CAN log", 2)
    learner = Learner(model, catalog_of(project), project.assembly)
    n = max(1, len(trace.frames))
    with virtual_bus(trace.frames, speed) as (source, is_over):
        for state in listen(source, learner, is_over):
            progress("learning from the bus", 0.2 + 0.3 * state.frames / n)
    return learner.estimator


def model_for(project: Project, samples: Samples) -> Model:
    """The declared model, with the sensor noise that the file leaves to be estimated."""
    if not project.noise_unknown:
        return project.model
    signals = project.model.signals
    noise = {s.name: _white_noise(samples, s) for s in signals if s.name in project.noise_unknown}
    return project.model_with(noise)


def _white_noise(samples: Samples, signal: Signal) -> float:
    """Noise of one signal beside its quantisation, which the model counts separately."""
    found = estimate_noise(1e-6 * samples.t_us, samples.column(signal.name))
    if not np.isfinite(found.relative_sd):
        raise NoSamplesError(
            f"{len(samples)} samples do not tell the noise of {signal.name}",
            f"give signals.{signal.name}.noise in the project file",
        )
    return float(np.sqrt(max(0.0, found.sd**2 - signal.resolution**2 / 12)))


def _fit(
    project: Project, model: Model, trace: Trace, span_s: tuple[float, float]
) -> tuple[RecordFit, Trace]:
    """Record path on the identification part; the trace with the offsets that were found."""
    tolerance = project.offset_tolerance_s
    chunk = _chunk(model, trace.samples, span_s)
    if not tolerance or trace.frames is None:
        return fit_record(model, chunk), trace
    catalog, frames = catalog_of(project), trace.frames

    def shifted(offsets_s: FloatArray) -> Samples:
        changes = dict(zip(tolerance, offsets_s, strict=True))
        return assemble(catalog, with_offsets(project.assembly, changes), frames)[0]

    def chunk_of(offsets_s: FloatArray) -> FloatArray:
        return _chunk(model, shifted(offsets_s), span_s)

    commands = {s.message for s in project.assembly.signals if s.command}
    lag_is_apart = not commands & set(tolerance)
    fit = fit_record(model, chunk, chunk_of, np.array(list(tolerance.values())), lag_is_apart)
    return fit, replace(trace, samples=shifted(fit.offsets_s))


def _chunk(model: Model, samples: Samples, span_s: tuple[float, float]) -> FloatArray:
    part = samples.between(*span_s)
    if len(part) == 0:
        raise NoSamplesError(
            f"no sample between {span_s[0]:g} and {span_s[1]:g} s",
            "adapt record.identification_s in the project file",
        )
    return to_chunk(model, part, int(samples.t_us[0]))


def with_offsets(assembly: Assembly, changes_s: dict[str, float]) -> Assembly:
    """The assembly with the offsets of some messages changed by so many seconds."""
    messages = tuple(
        replace(m, offset_s=m.offset_s + changes_s.get(m.name, 0.0)) for m in assembly.messages
    )
    return replace(assembly, messages=messages)
