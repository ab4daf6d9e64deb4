"""Which map is to be sent, and why it may be: the daemon's offer, or a file judged on a trace."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtid.apply import offer as offered
from rtid.apply.judge import Judgement, KnownMap, judge
from rtid.apply.plan import ApplyError
from rtid.apply.versions import Applied
from rtid.errors import RtidError
from rtid.estimator.chunk import to_chunk
from rtid.maps.files import read_map
from rtid.plain import FloatArray
from rtid.project import Project
from rtid.trace.reading import read_trace


@dataclass(frozen=True)
class Wish:
    """What was asked for; see the options of `rtid apply`."""

    undo: bool = False
    again: bool = False
    map_file: Path | None = None
    against: Path | None = None
    dry_run: bool = False
    bus: str | None = None
    state: Path | None = None
    replace_unknown: bool = False
    test_bus: bool = False


Wished = tuple[KnownMap, FloatArray, str, dict[str, Any]]


def wished(
    project: Project, folder: Path, wish: Wish, applied: Applied, content: int | None
) -> Wished:
    """The map to send, with the reason why it may be."""
    if wish.map_file is not None:
        return _from_file(project, wish, applied, content)
    offer = offered.read(folder)
    if content is not None and offer.against != content:
        beaten = offer.against or "none"
        raise ApplyError(
            f"the offer has beaten version {beaten}, but the controller holds {content}",
            "let the daemon judge anew",
            4,
        )
    why = f"Offered: {offer.sentence()}."
    return offer.known, offer.sd_pa, why, offer.provenance | {"judgement": offer.judgement}


def _from_file(project: Project, wish: Wish, applied: Applied, content: int | None) -> Wished:
    assert wish.map_file is not None
    flow_map, provenance = read_map(wish.map_file)
    new = KnownMap(flow_map, np.asarray(provenance.get("beta_pa", ()), float))
    if len(new.beta_pa) != len(project.model.chambers):
        raise ApplyError(f"{wish.map_file}: no bulk modulus per chamber", "export it anew")
    old = applied.known(content) if content is not None else None
    judgement = _judge_on(project, wish.against, provenance, old, new)
    if not judgement.is_better:
        raise ApplyError(
            f"{wish.map_file} does not beat the {judgement.against} on {wish.against}: "
            f"{judgement.reason}",
            "a map goes to the controller only after it has",
            4,
        )
    sd_pa = np.asarray(provenance.get("beta_sd_pa", np.zeros_like(new.beta_pa)), float)
    why = f"Judged on {wish.against}, {judgement.blocks} s of motion: {judgement.reason}."
    return new, sd_pa, why, dict(provenance) | {"judgement": judgement.as_json()}


def chunk_of(project: Project, trace: Path) -> FloatArray:
    """Samples of a trace (n, 2 + signals), SI, seconds from its first one."""
    samples = read_trace(project, trace).samples
    return to_chunk(project.model, samples, int(samples.t_us[0]))


def _judge_on(
    project: Project,
    trace: Path | None,
    provenance: Mapping[str, Any],
    old: KnownMap | None,
    new: KnownMap,
) -> Judgement:
    """Judge a map on a trace that it has not learned from, or on the trace's validation part."""
    if trace is None:
        raise RtidError("a map from a file must be judged first", "name a trace: --against", 2)
    chunk = chunk_of(project, trace)
    if provenance.get("source") == trace.name:
        part = project.sections.record.validation_s
        if part is None:
            raise ApplyError(
                f"the map was learned from {trace.name}: that cannot judge it",
                "name another trace, or set record.identification_s and validation_s apart",
            )
        chunk = chunk[(chunk[:, 0] >= part[0]) & (chunk[:, 0] < part[1])]
    return judge(project.model, chunk, old, new, project.sections.publish.gain_percent)
