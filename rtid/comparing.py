"""The engineer's first question: does the data sheet explain this trace, or the learned map.

Every map is held against the identification part and against the part that the fit has not seen,
never mixed; a reference gets the bulk modulus that suits it best on the identification part.
`compare_trace` holds the equation alone; `study` adds all that `rtid compare` shows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rtid.beside import replay_beside
from rtid.compare import (
    BlockRow,
    Candidate,
    Comparison,
    Deviation,
    Examination,
    LearnedReference,
    Reference,
    ReferenceMap,
    Visit,
    block_rows,
    compare,
    deviations,
    examine,
    learned,
    places,
    refitted,
    smooth_position,
)
from rtid.comparing_json import SCHEMA, as_json
from rtid.datasheet import read_reference
from rtid.estimator.flowmap import SHUT, VALID, FlowMap
from rtid.mapfiles import MAP_FILES, read_map
from rtid.model import FloatArray
from rtid.priors import find_prior, published
from rtid.project import Project, load
from rtid.replay import Replay

IDENTIFICATION, VALIDATION = "identification", "validation"
LEARNED = "learned"


@dataclass(frozen=True)
class Held:
    """One map held against the parts of a trace; beta_pa (chambers,) is what goes with it.

    examinations: by part, only in a `study`.
    """

    name: str
    beta_pa: np.ndarray
    parts: dict[str, Comparison]
    candidate: Candidate
    examinations: dict[str, Examination] = field(default_factory=dict)


@dataclass(frozen=True)
class TraceComparison:
    """Learned map first, then the references; tables per block (by part) and per edge."""

    replay: Replay
    flowmap: FlowMap
    references: tuple[Reference, ...]
    held: tuple[Held, ...]
    blocks_of: dict[str, list[BlockRow]]
    deviations_of: dict[str, list[Deviation]]

    @property
    def reference(self) -> Reference | None:
        """The first reference."""
        return self.references[0] if self.references else None

    @property
    def blocks(self) -> list[BlockRow]:
        """Blocks and what they leave in the identification part."""
        return self.blocks_of[IDENTIFICATION]

    @property
    def deviations(self) -> list[Deviation]:
        """Learned map beside the first reference."""
        return next(iter(self.deviations_of.values()), [])


def compare_trace(
    result: Replay, *references: Reference | None, name: str = LEARNED
) -> TraceComparison:
    """Hold the learned map, called `name`, and references against a replayed trace."""
    chunks = parts_of(result)

    def hold(candidate: Candidate) -> Held:
        parts = {
            title: compare(result.model, candidate, chunk, seen=title == IDENTIFICATION)
            for title, chunk in chunks.items()
        }
        return Held(candidate.name, 1.0 / candidate.compliance, parts, candidate)

    return _assembled(result, references, name, chunks[IDENTIFICATION], hold)


def study(
    result: Replay,
    *references: Reference | None,
    name: str = LEARNED,
    extra_flow: Mapping[str, FloatArray] | None = None,
) -> TraceComparison:
    """`compare_trace` with every map examined: simulated pressures, correlations, CUSUM and more.

    extra_flow: by part (samples - 1, chambers) in m3/s, what effects add to the modelled flow.
    """
    chunks, extra = parts_of(result), extra_flow or {}
    positions = {title: smooth_position(result.model, chunk) for title, chunk in chunks.items()}

    def hold(candidate: Candidate) -> Held:
        found: dict[str, Examination] = {}
        for title, chunk in chunks.items():
            seen, before = title == IDENTIFICATION, found.get(IDENTIFICATION)
            found[title] = examine(
                result.model,
                candidate,
                chunk,
                seen,
                before.equation if before else None,
                positions[title],
                extra.get(title),
            )
        parts = {title: one.equation for title, one in found.items()}
        return Held(candidate.name, 1.0 / candidate.compliance, parts, candidate, found)

    return _assembled(result, references, name, chunks[IDENTIFICATION], hold)


def _assembled(
    result: Replay,
    references: Sequence[Reference | None],
    name: str,
    chunk: FloatArray,
    hold: Callable[[Candidate], Held],
) -> TraceComparison:
    """Everything about the maps, each held by `hold`; chunk: the identification part."""
    flowmap = published(result.fit.solution, find_prior(result.project))
    known = tuple(reference for reference in references if reference is not None)
    candidates = [learned(result.fit, flowmap, name)]
    weights = result.fit.weights
    terms = candidates[0].terms if result.added else None
    candidates += [refitted(result.model, reference, weights, chunk, terms) for reference in known]
    held = tuple(hold(candidate) for candidate in candidates)
    blocks = {
        title: block_rows(result.fit.solution, part, flowmap)
        for title, part in held[0].parts.items()
    }
    differences = {reference.name: deviations(flowmap, reference) for reference in known}
    return TraceComparison(result, flowmap, known, held, blocks, differences)


def parts_of(result: Replay) -> dict[str, FloatArray]:
    """Samples of the identification part and, where there is one, of the held-out part."""
    spans = {IDENTIFICATION: result.identification_s}
    if result.validation_s is not None:
        spans[VALIDATION] = result.validation_s
    return {title: result.part(span) for title, span in spans.items()}


def compare_two(
    project: Project, trace: Path, against: Path, *references: Reference | None
) -> tuple[TraceComparison, TraceComparison]:
    """Two studies side by side; their learned maps are called by the files that differ.

    against: another project (.toml) for the same trace, or another trace for the same project.
    """
    other, other_trace, names = project, against, [trace.stem, against.stem]
    if against.suffix.lower() == ".toml":
        other, other_trace, names[0] = load(against), trace, project.path.stem
    if names[0] == names[1]:
        names = [f"{name} {k}" for k, name in enumerate(names, 1)]
    first = study(replay_beside(project, trace), *references, name=names[0])
    return first, study(replay_beside(other, other_trace), name=names[1])


def changes(first: TraceComparison, second: TraceComparison) -> list[Deviation]:
    """The first learned map beside the second, for the edges that both have."""
    other = LearnedReference(second.held[0].name, second.flowmap)
    names = {edge.name for edge in second.flowmap.edges}
    shared = FlowMap(tuple(edge for edge in first.flowmap.edges if edge.name in names))
    return deviations(shared, other)


def spans_of_block(found: TraceComparison, edge: str, i: int, j: int) -> list[tuple[float, float]]:
    """When the working point of an edge was in block (i, j), in s from the first sample.

    i counts along u, j along dp, from 0.  Raises NoSuchBlockError.
    """
    model, parts = found.replay.model, found.held[0].parts.values()
    return [span for part in parts for span in places.spans_of_block(model, part, edge, i, j)]


def blocks_in_span(found: TraceComparison, t0_s: float, t1_s: float) -> list[Visit]:
    """Blocks that the edges' working points were in between two instants, longest stay first."""
    model, total = found.replay.model, dict[tuple[str, int, int], float]()
    for part in found.held[0].parts.values():
        for visit in places.blocks_in_span(model, part, t0_s, t1_s):
            key = visit.edge, visit.i, visit.j
            total[key] = total.get(key, 0.0) + visit.time_s
    visits = [Visit(*key, time_s) for key, time_s in total.items()]
    return sorted(visits, key=lambda visit: -visit.time_s)


def find_reference(project: Project, path: Path | None) -> Reference | None:
    """The map at `path` (data sheet, or .json or .npz of `rtid export`), else the project's own."""
    if path is not None:
        if path.suffix.lower() in MAP_FILES:
            return LearnedReference(path.stem, read_map(path)[0])
        return read_reference(path)
    if not project.reference_maps:
        return None
    sheets = {edge: read_reference(file) for edge, file in project.reference_maps.items()}
    tables = {edge.casefold(): sheet.table(edge) for edge, sheet in sheets.items()}
    return ReferenceMap("reference map", tables)


def share_on_own_data(part: Comparison) -> float:
    """Share of the time with a flow in which every open edge is on a valid block."""
    moving = 1.0 - part.shares[SHUT]
    return part.shares[VALID] / moving if moving > 0 else 1.0


__all__ = [
    "IDENTIFICATION",
    "SCHEMA",
    "VALIDATION",
    "Held",
    "TraceComparison",
    "as_json",
    "blocks_in_span",
    "changes",
    "compare_trace",
    "compare_two",
    "find_reference",
    "share_on_own_data",
    "spans_of_block",
    "study",
]
