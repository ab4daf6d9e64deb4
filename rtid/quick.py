"""A file and nothing else: guess the roles, assume the rest, judge the data, name what is missing.

A project file is made of guesses and of assumptions that are all told; `rtid.check` and the
diagnosis then do with it what they do with any other.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rtid.check import Report, judge
from rtid.check.reading import Trace, read_trace
from rtid.diagnose.report import Diagnosis
from rtid.diagnosing import diagnose_trace
from rtid.errors import RtidError
from rtid.project import Project, load
from rtid.project.proposal import Candidate
from rtid.quick_data import BAD, Point, level_of, points
from rtid.quick_machine import (
    Assumption,
    Given,
    Machine,
    first_machine,
    fitted_machine,
)
from rtid.quick_project import of_missing, project_text
from rtid.quick_source import Source, open_source, roles_of
from rtid.replay import NoSamplesError, model_for

SCHEMA = 1
INSUFFICIENT = "insufficient_data"
TURNS = 2  # signs that may have to be turned round
SWAPPED = "chambers"

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Quick:
    """What a file tells without a project file.

    level: good, fair or bad; diagnosis: None where the data are too bad for one; dead_volume_m3:
    as given or assumed, beside which it says what was fitted.
    """

    path: Path
    dbc: str
    roles: dict[str, Candidate]
    assumptions: tuple[Assumption, ...]
    points: tuple[Point, ...]
    level: str
    diagnosis: Diagnosis | None
    cautions: tuple[str, ...]
    dead_volume_m3: float
    truncated: bool

    @property
    def is_enough(self) -> bool:
        """Whether there is a verdict that the data can bear."""
        return self.diagnosis is not None and self.diagnosis.verdict != INSUFFICIENT

    @property
    def next_command(self) -> str:
        """What to do now."""
        what = self.dbc or str(self.path)
        return f"rtid init {what} -o machine.toml"

    def as_json(self) -> dict[str, Any]:
        """Plain JSON types; numbers that are not finite are null."""
        return {
            "schema": SCHEMA,
            "file": str(self.path),
            "roles": {role: asdict(one) for role, one in self.roles.items()},
            "assumptions": [asdict(one) for one in self.assumptions],
            "data": {"level": self.level, "points": [asdict(one) for one in self.points]},
            "diagnosis": self.diagnosis.as_json() if self.diagnosis else None,
            "cautions": list(self.cautions),
            "dead_volume_m3": self.dead_volume_m3,
            "next": self.next_command,
        }


def _silent(_text: str, _share: float) -> None:
    pass


def quick(
    path: Path, dbc: Path | None = None, given: Given | None = None, progress: Progress = _silent
) -> Quick:
    """Judge a table or a CAN log.  Raises RtidError where it cannot be read or lacks a role."""
    given = given or Given()
    progress("reading", 0.0)
    source = open_source(path, dbc)
    roles = roles_of(path, source)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "machine.toml"
        found = _arranged(file, path, source, roles, given)
        progress("judging the data", 0.1)
        judged = points(found.project.model, found.trace, found.report)
        judged += _noise(found.project, found.trace)
        level, told = level_of(judged), None
        if level != BAD:
            told = _diagnosed(found.project, path, progress)
    return Quick(
        path,
        source.keys.get("dbc", ""),
        found.roles,
        (*of_missing(found.roles), *found.machine.assumptions),
        tuple(judged),
        level,
        told,
        tuple(_cautions(told, given)),
        found.machine.dead_volume_m3,
        bool(found.trace.refused.get("truncated")),
    )


def _diagnosed(project: Project, path: Path, progress: Progress) -> Diagnosis:
    """The diagnosis; RtidError for data that its numerics cannot bear: they are anybody's."""
    try:
        return diagnose_trace(project, path, lambda t, s: progress(t, 0.1 + 0.9 * s)).diagnosis
    except np.linalg.LinAlgError as error:
        raise RtidError(
            f"{path}: the fit fails on this data ({error})",
            "record more motion; if it looks sound to you, please report it with the file",
        ) from error


def _noise(project: Project, trace: Trace) -> list[Point]:
    """Whether the sensors' noise can be told from the record: without it nothing can be judged."""
    try:
        model_for(project, trace.samples)
    except NoSamplesError as error:
        remedy = "record a minute or two at even steps, without values that are missing"
        return [Point(BAD, str(error), remedy)]
    return []


@dataclass(frozen=True)
class Arranged:
    """Roles, machine and project that fit the motion, the record, and what `rtid check` says."""

    roles: dict[str, Candidate]
    machine: Machine
    project: Project
    trace: Trace
    report: Report


def _arranged(
    file: Path, path: Path, source: Source, roles: dict[str, Candidate], given: Given
) -> Arranged:
    """Roles and machine with the signs that the motion asks for, and what check says of them."""
    notes, turned = tuple[Assumption, ...](), frozenset[str]()
    while True:
        first = replace(first_machine(roles, given), reversed=turned)
        trace = read_trace(_project(file, path, source, roles, first), path)
        if len(trace.samples) < 2:
            raise RtidError(
                f"{path}: no two complete samples", "`rtid check` counts what is refused"
            )
        machine = fitted_machine(first, trace.samples)
        project = _project(file, path, source, roles, machine)
        report, turn = _judged(project, trace), ""
        if len(notes) < TURNS:
            turn = _turn(report)
        if turn == SWAPPED:
            roles = roles | {"p_a": roles["p_b"], "p_b": roles["p_a"]}
            what = f"{roles['p_a'].name} is the chamber that grows with x"
        elif turn:
            turned ^= {turn}
            what = f"{roles[turn].name} is read with the other sign"
        else:
            told = machine.assumptions + notes
            return Arranged(roles, replace(machine, assumptions=told), project, trace, report)
        notes += (Assumption(what, "the motion says so, but for another reason: check the wiring"),)


def _project(
    file: Path, path: Path, source: Source, roles: dict[str, Candidate], machine: Machine
) -> Project:
    file.write_text(project_text(path.stem or "machine", source, roles, machine), "utf-8")
    return load(file)


def _judged(project: Project, trace: Trace) -> Report:
    table = project.table_assembly
    assembly = table if trace.is_table and table else project.assembly
    stroke_m = project.sections.geometry.stroke_m
    return judge(
        project.model,
        assembly,
        trace.samples,
        trace.series,
        trace.messages,
        trace.refused,
        stroke_m,
    )


def _turn(report: Report) -> str:
    """The sign that the motion contradicts: u, x or the chambers; empty where it is content."""
    for finding in report.findings:
        is_sign = "swapped" in finding.text or "reversed" in finding.text
        if finding.level == "error" and is_sign and finding.subject in (SWAPPED, "u", "x"):
            return finding.subject
    return ""


def _cautions(found: Diagnosis | None, given: Given) -> list[str]:
    """What the verdict must not be taken for, where it stands on assumptions."""
    if found is None:
        return []
    names = [effect.effect for effect in found.found] + [s.effect for s in found.negligible]
    cautions = []
    if given.dead_volume_m3 is None and "entrained_air" in names:
        cautions.append(
            "Air and dead volume share what a chamber takes up: with --dead-volume (and the bore) "
            "the share of air is known, without it it may be twice too large."
        )
    both = ("internal_leakage", "external_leakage")
    if given.rod_m is None and any(name.startswith(both) for name in names):
        cautions.append(
            "The leak's size stands on the assumed diameters: --bore scales it, --rod moves it "
            "between internal and external."
        )
    return cautions
