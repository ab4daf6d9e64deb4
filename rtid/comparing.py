"""The engineer's first question: does the data sheet explain this trace, or the learned map.

Every map is held against the identification part and against the part that the fit has not seen,
never mixed; a data sheet gets the bulk modulus that suits it best on the identification part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtid.compare import (
    BlockRow,
    Candidate,
    Comparison,
    Deviation,
    ReferenceMap,
    block_rows,
    compare,
    deviations,
    learned,
    refitted,
)
from rtid.datasheet import read_reference
from rtid.estimator.flowmap import SHUT, VALID, FlowMap
from rtid.estimator.published import publish
from rtid.project import Project
from rtid.replay import Replay

IDENTIFICATION, VALIDATION = "identification", "validation"
SCHEMA = 1


@dataclass(frozen=True)
class Held:
    """One map held against the parts of a trace; beta_pa (chambers,) is what goes with it."""

    name: str
    beta_pa: np.ndarray
    parts: dict[str, Comparison]


@dataclass(frozen=True)
class TraceComparison:
    """Learned map first, then the reference if there is one; tables per block and per edge."""

    replay: Replay
    flowmap: FlowMap
    reference: ReferenceMap | None
    held: tuple[Held, ...]
    blocks: list[BlockRow]
    deviations: list[Deviation]


def compare_trace(result: Replay, reference: ReferenceMap | None = None) -> TraceComparison:
    """Hold the learned map, and a reference, against a replayed trace."""
    flowmap = publish(result.fit.solution)
    spans = {IDENTIFICATION: result.identification_s}
    if result.validation_s is not None:
        spans[VALIDATION] = result.validation_s
    chunks = {name: result.part(span) for name, span in spans.items()}
    candidates = [learned(result.fit, flowmap)]
    if reference is not None:
        weights = result.fit.weights
        candidates.append(refitted(result.model, reference, weights, chunks[IDENTIFICATION]))
    held = tuple(_hold(result, candidate, chunks) for candidate in candidates)
    blocks = block_rows(result.fit.solution, held[0].parts[IDENTIFICATION])
    differences = deviations(flowmap, reference) if reference is not None else []
    return TraceComparison(result, flowmap, reference, held, blocks, differences)


def _hold(result: Replay, candidate: Candidate, chunks: Mapping[str, np.ndarray]) -> Held:
    parts = {name: compare(result.model, candidate, chunk) for name, chunk in chunks.items()}
    return Held(candidate.name, 1.0 / candidate.compliance, parts)


def find_reference(project: Project, path: Path | None) -> ReferenceMap | None:
    """The data sheet at `path`, else those that the project names, else None."""
    if path is not None:
        return read_reference(path)
    if not project.reference_maps:
        return None
    sheets = {edge: read_reference(file) for edge, file in project.reference_maps.items()}
    tables = {edge.casefold(): sheet.table(edge) for edge, sheet in sheets.items()}
    return ReferenceMap("reference map", tables)


def as_json(found: TraceComparison) -> dict[str, Any]:
    """The comparison in plain JSON types, SI units; NaN is null."""
    solution = found.replay.fit.solution
    names = [chamber.name for chamber in found.replay.model.chambers]
    return {
        "schema": SCHEMA,
        "trace": str(found.replay.trace.path),
        "chambers": names,
        "rho_of_fit": solution.rho,
        "maps": [_held_json(held) for held in found.held],
        "blocks": [_plain(vars(row)) for row in found.blocks],
        "differences": [_deviation_json(d) for d in found.deviations],
    }


def _held_json(held: Held) -> dict[str, Any]:
    parts = {
        name: {
            "rows": len(part.t_s),
            "residual_rms_m3s": _plain(part.residual_rms_m3s) if len(part.t_s) else None,
            "residual_share_of_rms_flow": _plain(part.residual_share) if len(part.t_s) else None,
            "innovation_variance": _plain(part.rho),
            "share_of_time_by_status": part.shares,
        }
        for name, part in held.parts.items()
    }
    return {"name": held.name, "beta_pa": _plain(held.beta_pa), "parts": parts}


def _deviation_json(d: Deviation) -> dict[str, Any]:
    return {
        "edge": d.edge,
        "u_v": _plain(d.w_v),
        "dp_pa": _plain(d.dp_pa),
        "flow_m3s": _plain(d.flow_m3s),
        "sd_m3s": _plain(d.sd_m3s),
        "reference_m3s": _plain(d.reference_m3s),
        "status": d.status.tolist(),
    }


def _plain(value: Any) -> Any:
    """Arrays as lists and NaN as None, all the way down."""
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def share_on_own_data(part: Comparison) -> float:
    """Share of the time with a flow in which every open edge is on a valid block."""
    moving = 1.0 - part.shares[SHUT]
    return part.shares[VALID] / moving if moving > 0 else 1.0
