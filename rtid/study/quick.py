"""A file and nothing else: guess the roles, assume the rest, judge the data, name what is missing.

A project file is made of guesses and of assumptions that are all told; `rtid.trace` and the
diagnosis then do with it what they do with any other.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from rtid.diagnose.report import Diagnosis
from rtid.diagnose.verdict import INSUFFICIENT, UNKNOWN
from rtid.effects import catalogue
from rtid.errors import RtidError
from rtid.plain import Progress, silent
from rtid.project import Project, load
from rtid.project import guess as proposal
from rtid.project.guess import RoleCandidate, unused
from rtid.study.kept_record import model_for
from rtid.study.quick_machine import (
    Assumption,
    Given,
    MachineSizes,
    first_machine,
    fitted_machine,
)
from rtid.study.quick_project import DEAD_VOLUME, of_channels, of_missing, project_text
from rtid.study.quick_rate import QuickRate, quick_rate
from rtid.study.study import diagnose_trace
from rtid.trace import Report, judge
from rtid.trace.quick_data import BAD, Point, level_of, points
from rtid.trace.quick_source import Source, open_source, roles_of
from rtid.trace.reading import NoSamplesError
from rtid.trace.signals import Recording, read_recording

SCHEMA = 1
TURNS = 2  # signs that may have to be turned round
SWAPPED = "chambers"
CHAMBERS = {"p_a", "p_b"}
NOBODY: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class Quick:
    """What a file tells without a project file.

    unused: signals that play no role; level: good, fair or bad; diagnosis: None where the data are
    too bad for one; dead_volume_m3: as given or assumed, beside which it says what was fitted.
    """

    path: Path
    dbc: str
    roles: dict[str, RoleCandidate]
    unused: tuple[str, ...]
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
            "roles": {role: asdict(candidate) for role, candidate in self.roles.items()},
            "unused": list(self.unused),
            "assumptions": [asdict(candidate) for candidate in self.assumptions],
            "data": {
                "level": self.level,
                "points": [asdict(candidate) for candidate in self.points],
            },
            "diagnosis": self.diagnosis.as_json() if self.diagnosis else None,
            "cautions": list(self.cautions),
            "dead_volume_m3": self.dead_volume_m3,
            "next": self.next_command,
        }


def quick(
    path: Path,
    dbc: Path | None = None,
    given: Given | None = None,
    progress: Progress = silent,
    roles: Mapping[str, str] = NOBODY,
) -> Quick | QuickRate:
    """Judge a table or a CAN log; roles: names of signals by role, where guesses would fail.

    A table without pressures is one of a plant that is a rate.  Raises RtidError where the file
    cannot be read, or is of no kind of plant.
    """
    given = given or Given()
    progress("reading", 0.0)
    source = open_source(path, dbc)
    named = proposal.named(source.signals, roles)
    guessed = proposal.with_named(proposal.propose(source.signals), named)
    if "time_column" in source.keys and not CHAMBERS & guessed.keys():
        return quick_rate(path, source, named, progress)
    return _of_cylinder(path, source, roles_of(path, source, named), given, progress)


def _of_cylinder(
    path: Path,
    source: Source,
    roles: dict[str, RoleCandidate],
    given: Given,
    progress: Progress,
) -> Quick:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "machine.toml"
        arranged = _arranged(file, path, source, roles, given)
        progress("judging the data", 0.1)
        judged = points(arranged.project.model, arranged.trace, arranged.report)
        judged += _noise(arranged.project, arranged.trace)
        level, diagnosis = level_of(judged), None
        if level != BAD:
            diagnosis = _diagnosed(arranged.project, path, progress)
    return Quick(
        path,
        source.keys.get("dbc", ""),
        arranged.roles,
        tuple(candidate.full_name for candidate in unused(source.signals, arranged.roles)),
        (
            *of_missing(arranged.roles),
            *of_channels(source, arranged.roles),
            *arranged.machine.assumptions,
        ),
        tuple(judged),
        level,
        diagnosis,
        tuple(_cautions(diagnosis, given)),
        arranged.machine.dead_volume_m3,
        bool(arranged.trace.refused.get("truncated")),
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


def _noise(project: Project, trace: Recording) -> list[Point]:
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

    roles: dict[str, RoleCandidate]
    machine: MachineSizes
    project: Project
    trace: Recording
    report: Report


def _arranged(
    file: Path, path: Path, source: Source, roles: dict[str, RoleCandidate], given: Given
) -> Arranged:
    """Roles and machine with the signs that the motion asks for, and what check says of them."""
    notes, turned = tuple[Assumption, ...](), frozenset[str]()
    while True:
        first = replace(first_machine(roles, given), reversed=turned)
        trace = read_recording(_project(file, path, source, roles, first), path)
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
            assumptions = machine.assumptions + notes
            return Arranged(
                roles, replace(machine, assumptions=assumptions), project, trace, report
            )
        notes += (Assumption(what, "the motion says so, but for another reason: check the wiring"),)


def _project(
    file: Path, path: Path, source: Source, roles: dict[str, RoleCandidate], machine: MachineSizes
) -> Project:
    file.write_text(project_text(path.stem or "machine", source, roles, machine), "utf-8")
    return load(file)


def _judged(project: Project, trace: Recording) -> Report:
    table = project.table_assembly
    assembly = table if trace.is_table and table else project.assembly
    stroke_m = project.sections.stroke_m
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


def _cautions(diagnosis: Diagnosis | None, given: Given) -> list[str]:
    """What the verdict must not be taken for, where it stands on assumptions."""
    if diagnosis is None:
        return []
    names = [effect.effect for effect in diagnosis.found] + [s.effect for s in diagnosis.negligible]
    pages = catalogue()
    stood_on = {size for name in names if name in pages for size in pages[name].stands_on}
    cautions = []
    if given.dead_volume_m3 is None and DEAD_VOLUME in stood_on:
        cautions.append(
            "Air and dead volume share what a chamber takes up: with --dead-volume (and the bore) "
            "the share of air is known, without it it may be twice too large."
        )
    if diagnosis.verdict == UNKNOWN:
        cautions.append(
            "What is assumed above may leave that by itself, safe band and diameters first: "
            "a project file has them right."
        )
    if given.rod_m is None and "diameters" in stood_on:
        cautions.append(
            "The leak's size stands on the assumed diameters: --bore scales it, --rod moves it "
            "between internal and external."
        )
    return cautions
