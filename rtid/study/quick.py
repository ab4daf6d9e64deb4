"""A file and nothing else: guess the roles, assume the rest, judge the data, name what is missing.

A project file is made of guesses and of assumptions that are all told; `rtid.trace` and the
diagnosis then do with it what they do with any other.
"""

from __future__ import annotations

import shlex
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from firmware_bridge.catalog import BUILTIN, places
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.verdict import INSUFFICIENT, MATCHES, MISSING, UNKNOWN
from rtid.effects import catalogue
from rtid.effects.page import DEAD_VOLUME
from rtid.errors import RtidError
from rtid.plain import Progress, silent
from rtid.project import Project, load
from rtid.project import guess as proposal
from rtid.project.guess import RoleCandidate, unused
from rtid.study.kept_record import model_for
from rtid.study.quick_command import Reading, between_rows, hidden_s, on_a_line, said_of
from rtid.study.quick_log import written_late
from rtid.study.quick_machine import (
    Assumption,
    Given,
    MachineSizes,
    counted_from,
    first_machine,
    fitted_machine,
    lag_of,
)
from rtid.study.quick_overlap import below_its_band
from rtid.study.quick_pressures import from_air
from rtid.study.quick_project import (
    head_of,
    of_channels,
    of_missing,
    of_neutral,
    of_units,
    project_text,
)
from rtid.study.quick_rate import QuickRate, quick_rate
from rtid.study.rate_pairs import driven_pairs, pressed_pairs
from rtid.study.rate_project import of_records, placed_near
from rtid.study.study import Study
from rtid.trace.check import Report, judge
from rtid.trace.coarse import at_crossings
from rtid.trace.quick_data import BAD, Point, level_of, points
from rtid.trace.quick_source import Source, open_source, refuse_unknown_units, roles_of
from rtid.trace.reading import NoSamplesError, noise_of
from rtid.trace.signals import Recording, read_recording

if TYPE_CHECKING:
    from rtid.study.quick_plant import QuickPlant

SCHEMA = 1
TURNS = 2  # signs that may have to be turned round
LAG_KNOWN_S = 3e-4  # deviation up to which a record tells the lag of the spools
SWAPPED = "chambers"
CHAMBERS = {"p_a", "p_b"}
NOBODY: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class Quick:
    """What a file tells without a project file.

    level: good, fair or bad; diagnosis: None where the data are too bad for one; options: of the
    command line that said the rest.  records: of the project, where they are several; what is told
    is of the first; held_out: names of those that judge, else the last one.
    """

    path: Path
    source: Source
    roles: dict[str, RoleCandidate]
    machine: MachineSizes
    points: tuple[Point, ...]
    level: str
    diagnosis: Diagnosis | None
    cautions: tuple[str, ...]
    truncated: bool
    options: str = ""
    records: tuple[Path, ...] = ()
    held_out: tuple[str, ...] = ()

    @property
    def is_enough(self) -> bool:
        """Whether there is a verdict that the data can bear."""
        return self.diagnosis is not None and self.diagnosis.verdict != INSUFFICIENT

    @property
    def unused(self) -> tuple[str, ...]:
        """Signals that play no role."""
        return tuple(candidate.full_name for candidate in unused(self.source.signals, self.roles))

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """Whatever nobody has said."""
        missing = of_missing(self.roles, self.machine.supply_pa)
        channels = of_channels(self.source, self.roles)
        neutral = of_neutral(self.roles["u"], self.machine)
        return (*missing, *of_units(self.roles), *neutral, *channels, *self.machine.assumptions)

    def text_for(self, file: Path) -> str:
        """The project file that was judged, with its assumptions, as it is written to a file."""
        source, dbc = self.source, self.source.keys.get("dbc", "")
        if dbc and not dbc.startswith(BUILTIN):
            near = (
                place.named(proposal.relative(place.file, file.parent)) for place in places(dbc)
            )
            source = replace(source, keys=source.keys | {"dbc": ", ".join(near)})
        text = head_of(self.assumptions)
        text += project_text(file.stem, source, self.roles, self.machine)
        if not self.records:
            return text
        return placed_near(of_records(text, self.records, self.held_out), self.records, file)

    @property
    def next_command(self) -> str:
        """What writes the project."""
        files = " ".join(map(str, self.records or [self.path]))
        return f"rtid quick {files}{self.options} --save machine.toml"

    def after(self, project: Path) -> str:
        """What to do with the project once it is written."""
        verdict = self.diagnosis.verdict if self.diagnosis else INSUFFICIENT
        trace = f"{self.path} -p {project}"
        if self.records:
            return f"rtid diagnose {trace}"
        if verdict == MISSING:
            return f"rtid add {trace}"
        if verdict == MATCHES:
            return f"rtid export {self.path} maps.csv -p {project}"
        if verdict == INSUFFICIENT:
            return f"rtid quick ANOTHER_FILE{self.options}"
        return f"rtid report {trace}"

    def as_json(self, saved: Path | None = None) -> dict[str, Any]:
        """Plain JSON types; numbers that are not finite are null.  saved: where its project is."""
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
            "dead_volumes_m3": dict(zip("ab", self.machine.dead_volumes_m3, strict=True)),
            "next": self.after(saved) if saved else self.next_command,
        }


def quick(
    path: Path,
    dbc: Path | None = None,
    given: Given | None = None,
    progress: Progress = silent,
    roles: Mapping[str, str] = NOBODY,
    more: Sequence[Path] = (),
    held_out: Sequence[str] = (),
) -> Quick | QuickRate | QuickPlant:
    """Judge a table or a CAN log; roles: names of signals by role, where guesses would fail.

    A table without pressures is one of a plant that is a rate, or one of its equations where it
    empties or cools down by itself.  more: further records of the plant, of which those named
    held_out judge, or the last; of a cylinder the first is judged, and the project is of all.
    Raises RtidError where the file cannot be read, or is of no kind of plant.
    """
    given = given or Given()
    progress("reading", 0.0)
    source = open_source(path, dbc)
    named = proposal.named(source.signals, roles)
    guessed = proposal.with_named(proposal.propose(source.signals), named)
    refuse_unknown_units(path, source, guessed)
    is_table = "time_column" in source.keys
    if is_table and _is_rate(path, source, guessed, named):
        from rtid.study.quick_plant import quick_plant  # noqa: PLC0415 - brings the plants with it

        by_equations = None if more else quick_plant(path, source, named, progress)
        return by_equations or quick_rate(path, source, named, progress, more, held_out)
    played = roles_of(path, source, named)
    if given.supply_pa is not None and "p_supply" in played:
        measured = played["p_supply"].full_name
        raise RtidError(f"{path}: {measured} measures the supply", "leave its pressure out", 2)
    looked = _of_cylinder(path, source, played, given, progress)
    options = _options(dbc, given, roles) + "".join(f" --held-out {name}" for name in held_out)
    several = (path, *more) if more else ()
    return replace(looked, options=options, records=several, held_out=tuple(held_out))


def _is_rate(
    path: Path,
    source: Source,
    guessed: Mapping[str, RoleCandidate],
    named: Mapping[str, RoleCandidate],
) -> bool:
    """True for a table of no cylinder with valves: no chambers, or driven by a pump, or pulled."""
    if not CHAMBERS & guessed.keys() or driven_pairs(path, source, named):
        return True
    return "u" not in guessed and bool(pressed_pairs(path, source, named))


def _options(dbc: Path | None, given: Given, roles: Mapping[str, str]) -> str:
    """The words that say the same on the command line."""
    lengths = {"bore": given.bore_m, "rod": given.rod_m, "stroke": given.stroke_m}
    words = [("dbc", str(dbc))] if dbc else []
    words += [(name, f"{1e3 * size:g}") for name, size in lengths.items() if size is not None]
    if given.dead_volumes_m3 is not None:
        words.append(("dead-volume", ",".join(f"{1e3 * v:g}" for v in given.dead_volumes_m3)))
    if given.safe_band is not None:
        words.append(("safe-band", f"{given.safe_band:g}"))
    if given.lag_s is not None:
        words.append(("lag", f"{1e3 * given.lag_s:g}"))
    if given.supply_pa is not None:
        words.append(("supply", f"{1e-6 * given.supply_pa:g}"))
    words += [("role", f"{role}={name}") for role, name in roles.items()]
    return "".join(f" --{name} {shlex.quote(value)}" for name, value in words)


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
        record = arranged.trace, arranged.report, given.supply_pa is not None
        judged = points(arranged.project.model, *record)
        noise, doubts = _noise(arranged.project, arranged.trace)
        judged += doubts
        level, diagnosis, machine = level_of(judged), None, arranged.machine
        if level != BAD:
            is_known = given.safe_band is not None
            diagnosis, machine = _likeliest(file, path, source, arranged, progress, is_known)
        late_s = _hidden_s(arranged.trace, machine)
    return Quick(
        path,
        source,
        arranged.roles,
        replace(
            machine,
            noise_seen=noise,
            extra_volumes=_fitted_volumes(diagnosis),
            lag_seen_s=_lag_seen_s(diagnosis),
        ),
        tuple(judged),
        level,
        between_rows(diagnosis, late_s) if diagnosis else None,
        tuple(_cautions(diagnosis, given, arranged.roles)),
        bool(arranged.trace.refused.get("truncated")),
    )


def _fitted_volumes(diagnosis: Diagnosis | None) -> dict[str, tuple[float, float]]:
    """Dead volume of each chamber beyond the assumed one, m3, with its standard deviation."""
    volumes = {a.where: a.parameters["volume"] for a in (diagnosis.added if diagnosis else ())}
    return {where: (volume.value, volume.std) for where, volume in volumes.items()}


def _lag_seen_s(diagnosis: Diagnosis | None) -> float | None:
    """The spools' lag where the record tells it to `LAG_KNOWN_S`."""
    if diagnosis is None or not diagnosis.lag_sd_s < LAG_KNOWN_S:  # nan: it does not
        return None
    return diagnosis.lag_s


def _likeliest(
    file: Path,
    path: Path,
    source: Source,
    arranged: Arranged,
    progress: Progress,
    band_is_known: bool,
) -> tuple[Diagnosis, MachineSizes]:
    """The diagnosis, and the machine of it: with band and command as the record likes them."""

    def at(machine: MachineSizes) -> Study:
        return Study(_project(file, path, source, arranged.roles, machine), path)

    study = Study(arranged.project, path, _later(progress))
    reading = Reading(study, arranged.machine, said_of(study))
    of_tables = (written_late, on_a_line) if arranged.trace.is_table else ()
    of_bands = () if band_is_known else (below_its_band,)
    for another in (*of_bands, from_air, *of_tables):
        if reading.said.verdict == MATCHES:
            break
        with suppress(np.linalg.LinAlgError, RtidError):  # it cannot be had so: as it was before
            reading = another(reading, at)
    return reading.said, reading.machine


def _hidden_s(trace: Recording, machine: MachineSizes) -> float:
    """What the rows of a table hide of the spools' lag, s; nothing of a log of messages."""
    if not trace.is_table:
        return 0.0
    return hidden_s(trace.samples, machine.command_step_s > 0.0, 1e-3 * lag_of(machine)[1])


def _later(progress: Progress) -> Progress:
    """What is done after the data are judged."""
    return lambda text, share: progress(text, 0.1 + 0.9 * share)


def _noise(project: Project, trace: Recording) -> tuple[dict[str, float], list[Point]]:
    """The sensors' noise in the record, 1 sigma in SI by signal: else nothing can be judged."""
    try:
        model = model_for(project, trace.samples, noise_of(project, trace.series))
    except NoSamplesError as error:
        remedy = "record a minute or two at even steps, without values that are missing"
        return {}, [Point(BAD, str(error), remedy)]
    return {s.name: s.noise for s in model.signals if s.name in project.noise_unknown}, []


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
    notes, turned, zero = tuple[Assumption, ...](), frozenset[str](), None
    while True:
        first = replace(first_machine(roles, given, zero or 0.0), reversed=turned)
        project = _project(file, path, source, roles, first)
        trace = read_recording(project, path)
        if len(trace.samples) < 2:
            raise RtidError(
                f"{path}: no two complete samples", "`rtid check` counts what is refused"
            )
        if zero is None and (zero := counted_from(trace.samples)):
            continue
        # over 20 ms a position in steps of 0.5 mm stands still up to 25 mm/s
        lines = at_crossings(project.model, trace.samples)[0].values
        machine = fitted_machine(first, replace(trace.samples, values=lines))
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
        trace.jitter_s,
    )


def _turn(report: Report) -> str:
    """The sign that the motion contradicts: u, x or the chambers; empty where it is content."""
    for finding in report.findings:
        is_sign = "swapped" in finding.text or "reversed" in finding.text
        if finding.level == "error" and is_sign and finding.subject in (SWAPPED, "u", "x"):
            return finding.subject
    return ""


def _cautions(
    diagnosis: Diagnosis | None, given: Given, roles: Mapping[str, RoleCandidate]
) -> list[str]:
    """What the verdict must not be taken for, where it stands on assumptions."""
    if diagnosis is None:
        return []
    names = [effect.effect for effect in diagnosis.found] + [s.effect for s in diagnosis.negligible]
    pages = catalogue()
    stood_on = {size for name in names if name in pages for size in pages[name].stands_on}
    cautions = []
    if given.dead_volumes_m3 is None and DEAD_VOLUME in stood_on:
        cautions.append(
            "Air and dead volume share what a chamber takes up: with --dead-volume (and the bore) "
            "the share of air is known, without it it may be twice too large."
        )
    is_assumed = "p_supply" not in roles and given.supply_pa is None
    if diagnosis.verdict == UNKNOWN:
        first = "the supply's pressure first: one that varies does; log it, or say it (--supply)"
        usual = "safe band and diameters first: a project file has them right"
        cautions.append(
            f"What is assumed above may leave that by itself, {first if is_assumed else usual}."
        )
    elif is_assumed:
        cautions.append("The maps stand on the supply's pressure, which is assumed (--supply).")
    if given.rod_m is None and "diameters" in stood_on:
        cautions.append(
            "The leak's size stands on the assumed diameters: --bore scales it, --rod moves it "
            "between internal and external."
        )
    return cautions
