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

from rtid.compare import (
    BlockRow,
    CandidateMap,
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
from rtid.errors import door
from rtid.estimator.flowmap import SHUT, VALID, FlowMap
from rtid.maps.datasheet import read_reference
from rtid.maps.files import MAP_FILES, read_map
from rtid.plain import FloatArray
from rtid.project import Project
from rtid.study.compared_json import SCHEMA, as_json
from rtid.study.kept_record import Replay

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
    candidate: CandidateMap
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


@door
def compare_trace(
    result: Replay, *references: Reference | None, name: str = LEARNED
) -> TraceComparison:
    """Hold the learned map, called `name`, and references against a replayed trace."""
    chunks = parts_of(result)

    def hold(candidate: CandidateMap) -> Held:
        parts = {
            title: compare(result.model, candidate, chunk, seen=title == IDENTIFICATION)
            for title, chunk in chunks.items()
        }
        with np.errstate(divide="ignore"):  # no compliance seen: an infinite modulus
            return Held(candidate.name, 1.0 / candidate.compliance, parts, candidate)

    return _assembled(result, references, name, chunks[IDENTIFICATION], hold)


@door
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

    def hold(candidate: CandidateMap) -> Held:
        examinations: dict[str, Examination] = {}
        for title, chunk in chunks.items():
            seen, before = title == IDENTIFICATION, examinations.get(IDENTIFICATION)
            examinations[title] = examine(
                result.model,
                candidate,
                chunk,
                seen,
                before.equation if before else None,
                positions[title],
                extra.get(title),
            )
        parts = {title: examination.equation for title, examination in examinations.items()}
        with np.errstate(divide="ignore"):  # of a plant without pressures: none
            beta_pa = 1.0 / candidate.compliance
        return Held(candidate.name, beta_pa, parts, candidate, examinations)

    return _assembled(result, references, name, chunks[IDENTIFICATION], hold)


def _assembled(
    result: Replay,
    references: Sequence[Reference | None],
    name: str,
    chunk: FloatArray,
    hold: Callable[[CandidateMap], Held],
) -> TraceComparison:
    """Everything about the maps, each held by `hold`; chunk: the identification part."""
    flowmap = result.map
    known = tuple(reference for reference in references if reference is not None)
    candidates = [learned(result.fit, flowmap, name)]
    weights = result.fit.weights
    terms = candidates[0].terms if result.added else None
    candidates += [refitted(result.model, reference, weights, chunk, terms) for reference in known]
    tested = tuple(hold(candidate) for candidate in candidates)
    blocks = {
        title: block_rows(result.fit.solution, part, flowmap)
        for title, part in tested[0].parts.items()
    }
    differences = {reference.name: deviations(flowmap, reference) for reference in known}
    return TraceComparison(result, flowmap, known, tested, blocks, differences)


def parts_of(result: Replay) -> dict[str, FloatArray]:
    """Samples of the identification part and, where there is one, of the held-out part.

    Each (n, 2 + signals), SI.
    """
    spans = {IDENTIFICATION: result.identification_s}
    if result.validation_s is not None:
        spans[VALIDATION] = result.validation_s
    return {title: result.part(span) for title, span in spans.items()}


def changes(first: TraceComparison, second: TraceComparison) -> list[Deviation]:
    """The first learned map beside the second, for the edges that both have."""
    other = LearnedReference(second.held[0].name, second.flowmap)
    names = {edge.name for edge in second.flowmap.edges}
    shared = FlowMap(tuple(edge for edge in first.flowmap.edges if edge.name in names))
    return deviations(shared, other)


@door
def spans_of_block(
    comparison: TraceComparison, edge: str, i: int, j: int
) -> list[tuple[float, float]]:
    """When the working point of an edge was in block (i, j), in s from the first sample.

    i counts along u, j along dp, from 0.  Raises NoSuchBlockError.
    """
    model, parts = comparison.replay.model, comparison.held[0].parts.values()
    return [span for part in parts for span in places.spans_of_block(model, part, edge, i, j)]


@door
def blocks_in_span(comparison: TraceComparison, t0_s: float, t1_s: float) -> list[Visit]:
    """Blocks that the edges' working points were in between two instants, longest stay first."""
    model, total = comparison.replay.model, dict[tuple[str, int, int], float]()
    for part in comparison.held[0].parts.values():
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
    "find_reference",
    "share_on_own_data",
    "spans_of_block",
    "study",
]
