"""Which traces there are, and to which machine each belongs.

A trace belongs to the machine that its folder is named for; a `project.toml` in that folder is the
machine's own, and else the fleet's project holds.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from firmware_bridge.sources.formats import has_known_suffix, suffixes
from rtid.errors import RtidError

NOTES = ".txt"  # may be a table, but in a folder of traces it is a note
OWN_PROJECT = "project.toml"
ALONE = "machine"  # name of the machine of traces that lie in the folder that was named itself
DIGITS = 20  # of the key: SHA-256 of the trace


@dataclass(frozen=True)
class TraceJob:
    """A trace of a machine; key: from its content, so that a copy is the same job."""

    trace: Path
    machine: str
    project: Path
    key: str


def find(sources: Iterable[Path], project: Path | None) -> tuple[list[TraceJob], list[Path]]:
    """All jobs under folders or of single files, in order, and the copies that were left out.

    Raises RtidError where there is nothing, or a trace without a project.
    """
    jobs: dict[str, TraceJob] = {}
    copies = []
    for trace, machine in _traces(sources):
        project_file = _project_of(trace, project).resolve()
        job = TraceJob(trace.resolve(), machine, project_file, key_of(trace))
        if job.key in jobs:
            copies.append(trace)
        jobs.setdefault(job.key, job)
    if not jobs:
        known = ", ".join(suffixes())
        raise RtidError("no trace found", f"name folders or files that end in {known}")
    return list(jobs.values()), copies


def key_of(trace: Path) -> str:
    """Key of a trace by its content; an empty one is no copy of another, each has its error."""
    if not trace.stat().st_size:
        return hashlib.sha256(str(trace.resolve()).encode()).hexdigest()[:DIGITS]
    with trace.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:DIGITS]


def _traces(sources: Iterable[Path]) -> Iterator[tuple[Path, str]]:
    for source in sources:
        if not source.exists():
            raise RtidError(f"{source}: no such file or folder")
        if source.is_file():
            yield source, source.resolve().parent.name
            continue
        for path in sorted(source.rglob("*")):
            if path.is_file() and path.suffix != NOTES and has_known_suffix(path):
                yield path, path.parent.name if path.parent != source else ALONE


def _project_of(trace: Path, project: Path | None) -> Path:
    beside = trace.parent / OWN_PROJECT
    if beside.is_file():
        return beside
    if project is None:
        raise RtidError(f"{trace}: no project file", f"give --project, or {beside}")
    return project
