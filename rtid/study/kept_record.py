"""What a record is learned from and what comes of it: samples, noise, message ages, the estimate.

frames -> Assembler -> Samples -> Estimator (nominal weights, whole trace: what the daemon has), and
the one fit of the part that teaches, with the maps of the record beside it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from firmware_bridge.config import Assembly
from firmware_bridge.samples import Samples
from rtid.errors import RtidError
from rtid.estimator.chunk import to_chunk
from rtid.estimator.coloured import sensor_noise
from rtid.estimator.estimator import Estimator
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.noise import NoiseEstimate
from rtid.estimator.record import RecordFit, fit_record
from rtid.maps.prior_map import find_prior, published
from rtid.model import Machine, Signal
from rtid.plain import FloatArray, Progress
from rtid.project import Project
from rtid.trace.coarse import at_crossings
from rtid.trace.described import catalog_of
from rtid.trace.late_stamps import frames_in_time
from rtid.trace.learner import Learner, listen, virtual_bus
from rtid.trace.measured import with_sums
from rtid.trace.reading import AT_ONCE, NoSamplesError, Trace, assemble, whole

if TYPE_CHECKING:
    from rtid.study.known_effects import KnownEffect


NOTHING: Mapping[str, NoiseEstimate] = MappingProxyType({})


@dataclass(frozen=True)
class Replay:
    """A replayed trace: what was learned from it, by the one fit of its record.

    declared: the machine with the noise of its sensors; added: effects of the model beside which
    `fit` was learned; model and chunk are those of the machine with them.
    """

    project: Project
    declared: Machine
    model: Machine
    trace: Trace
    fit: RecordFit
    chunk: FloatArray
    identification_s: tuple[float, float]
    validation_s: tuple[float, float] | None
    added: tuple[KnownEffect, ...] = ()

    @cached_property
    def live(self) -> Estimator:
        """What the daemon would have learned of the whole trace, with nominal weights."""
        return as_on_board(self.project, self.declared, self.trace)

    @cached_property
    def map(self) -> FlowMap:
        """The learned flow maps Q(u, dp), with the project's prior where data do not tell."""
        return published(self.fit.solution, find_prior(self.project))

    def part(self, span_s: tuple[float, float]) -> FloatArray:
        """Rows (n, 2 + signals), SI, with span_s[0] <= t < span_s[1] from the first sample."""
        return within(self.chunk, span_s)


@dataclass(frozen=True)
class MessageAges:
    """Changes of the message offsets that a record shows, and their deviations (m,), seconds."""

    offsets_s: FloatArray
    sd_s: FloatArray


def as_on_board(project: Project, model: Machine, trace: Trace) -> Estimator:
    """The estimate from the frames, through the gates of the daemon; a table has passed its own."""
    if trace.log is None:
        live = Estimator(model)
        live.update(trace.samples)
        return live
    learner = Learner(model, catalog_of(project), project.assembly, project.flows)
    for part in trace.log.read().chunks(AT_ONCE):
        learner.push(part)
    learner.finish()
    return learner.estimator


def through_bus(
    project: Project, model: Machine, trace: Trace, speed: float, progress: Progress
) -> Estimator:
    """The estimate from the same frames, sent over a virtual bus."""
    if trace.log is None:
        raise RtidError(f"{trace.path}: a table has no frames for a bus", "give a CAN log", 2)
    learner = Learner(model, catalog_of(project), project.assembly, project.flows)
    n = max(1, len(trace.log))
    with virtual_bus(trace.log.read(), speed) as (source, is_over):
        for state in listen(source, learner, is_over):
            progress("learning from the bus", 0.2 + 0.3 * state.frames / n)
    return learner.estimator


def model_for(
    project: Project,
    samples: Samples,
    measured: Mapping[str, NoiseEstimate] = NOTHING,
    crossed: Collection[str] = (),
) -> Machine:
    """The declared model, with the sensor noise that the file leaves to be estimated.

    measured: the noise at the instants at which signals were measured, where those are known.
    crossed: signals whose steps are known by where they cross them, see `Trace`.
    """
    model = project.model
    if crossed:
        left = {name: measured[name].resolution for name in crossed}
        signals = (replace(s, resolution=left.get(s.name, s.resolution)) for s in model.signals)
        model = replace(model, signals=tuple(signals))
    unknown = [s for s in model.signals if s.name in project.noise_unknown]
    if not unknown:
        return model
    return model.with_noise(
        {s.name: _white_noise(model, samples, s, measured.get(s.name)) for s in unknown}
    )


def _white_noise(
    model: Machine, samples: Samples, signal: Signal, measured: NoiseEstimate | None
) -> float:
    """Noise of one signal beside its quantisation, which the model counts separately.

    By the samples alone one that is read off a line between two messages has none: healthy logs
    of messages at their own instants left rho 50.
    """
    values = samples.column(signal.name)
    if signal.resolution and len(values) and np.ptp(values) < signal.resolution:
        return 0.0  # it stays within one step
    result = measured or sensor_noise(model, signal.name, 1e-6 * samples.t_us, values).noise
    if not np.isfinite(result.relative_sd):
        raise NoSamplesError(
            f"{len(samples)} samples do not tell the noise of {signal.name}",
            f"give signals.{signal.name}.noise in the project file",
        )
    return float(np.sqrt(max(0.0, result.sd**2 - signal.resolution**2 / 12)))


def aged(project: Project, model: Machine, trace: Trace) -> tuple[Trace, MessageAges]:
    """The trace at the message ages that it shows, where nobody has declared them."""
    tolerance, nothing = project.offset_tolerance_s, np.zeros(0)
    if not tolerance or trace.log is None:
        return trace, MessageAges(nothing, nothing)
    catalog = catalog_of(project)
    frames, _ = frames_in_time(trace.log.read(), project.assembly, catalog)
    span_s = taught_s(project)

    def shifted(offsets_s: FloatArray) -> Samples:
        changes = dict(zip(tolerance, offsets_s, strict=True))
        moved = with_offsets(project.assembly, changes)
        samples = with_sums(project, whole(project, *assemble(catalog, moved, frames))[0])
        return at_crossings(model, samples)[0] if trace.crossed else samples

    def chunk_of(offsets_s: FloatArray) -> FloatArray:
        return _chunk(model, shifted(offsets_s), span_s)

    commands = {s.message for s in project.assembly.signals if s.command}
    lag_is_apart = not commands & set(tolerance)
    chunk, widths = chunk_of(np.zeros(len(tolerance))), np.array(list(tolerance.values()))
    fit = fit_record(model, chunk, chunk_of, widths, lag_is_apart)
    return replace(trace, samples=shifted(fit.offsets_s)), MessageAges(
        fit.offsets_s, fit.offsets_sd_s
    )


def within(chunk: FloatArray, span_s: tuple[float, float]) -> FloatArray:
    """Rows of a chunk (n, 2 + signals), SI, with span_s[0] <= t < span_s[1]: a view of it."""
    return chunk[slice(*np.searchsorted(chunk[:, 0], span_s))]


def taught_s(project: Project) -> tuple[float, float]:
    """The span from which the maps are learned: as declared, else the whole record."""
    return project.sections.record.identification_s or (0.0, np.inf)


def _chunk(model: Machine, samples: Samples, span_s: tuple[float, float]) -> FloatArray:
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
