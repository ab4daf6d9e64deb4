"""What the worker does: open a record, say what is missing, add it, take it back, write files.

It holds the fits; what it returns is plain and small enough to be sent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from rtid.compare import Reference
from rtid.diagnose.report import Diagnosis
from rtid.errors import RtidError
from rtid.maps.files import formats
from rtid.plain import Progress
from rtid.project import load
from rtid.project.added import AddedSection, text_with
from rtid.project.history import ADD, DROP, text_of, write
from rtid.study.compared import find_reference
from rtid.study.look import Look, RecordShare, look
from rtid.study.quick import quick
from rtid.study.quick_machine import Given
from rtid.study.quick_plant import QuickPlant
from rtid.study.quick_rate import QuickRate
from rtid.study.revisions import change_of, undo, undo_command, with_effect, without
from rtid.study.study import Study
from rtid.tell.charts.evidence import charts_of
from rtid.tell.diagnosed import heading
from rtid.tell.quick import lines, rate_lines
from rtid.tell.quick_equations import plant_lines
from rtid.tell.report_story import Ranked, ranked
from rtid.tell.story import Chart
from rtid.tell.words import VERDICTS
from rtid.trace.glance import Glance, glance
from rtid.ui.reader import Reader
from rtid.ui.release_form import Released, ReleaseWish, release
from rtid.ui.sending import Sending, Way, foretell, send
from rtid.ui.upload import free_name


@dataclass(frozen=True)
class Opened:
    """A record that was read and learned from; flow_unit: SI unit of what its maps give."""

    project: str
    trace: str
    duration_s: float
    samples: int
    refused: dict[str, int]
    look: Look
    added: tuple[AddedSection, ...]
    reference: Reference | None
    flow_unit: str = "m3/s"


@dataclass(frozen=True)
class RankedDiagnosis:
    """A diagnosis, the ranking of its candidates, and the evidence for what is named."""

    diagnosis: Diagnosis
    ranking: tuple[Ranked, ...]
    evidence: tuple[Chart, ...] = ()


@dataclass(frozen=True)
class Addition:
    """An effect that was added, or dropped: the new model, its errors, what to say of it."""

    section: AddedSection
    sections: tuple[AddedSection, ...]
    note: str


@dataclass(frozen=True)
class Judged:
    """The verdict of a file alone: kind for the colour, all lines, and the project as a text.

    project: where it would be saved; None for equations, which have no maps for the page.
    """

    kind: str
    heading: str
    lines: tuple[str, ...]
    project: Path | None
    text: str


@dataclass(frozen=True)
class Saved:
    """What was written to the project file."""

    note: str


@dataclass
class _Revision:
    """A study with the effects of its revision, and what led to it.

    What it shows is the page's: the worker would hold the record once more.  seen: until the page
    asks for it; ready: the next ones, by effect, place and reason.
    """

    study: Study
    kind: str = ""
    section: AddedSection | None = None
    note: str = ""
    is_saved: bool = False
    seen: Look | None = None
    ready: dict[tuple[str, str, str], _Revision] = field(default_factory=dict)

    @property
    def sections(self) -> tuple[AddedSection, ...]:
        """The effects of the model."""
        return self.study.project.sections.added


def _addition(made: _Revision) -> Addition:
    assert made.section is not None
    return Addition(made.section, made.sections, made.note)


def _looked(study: Study) -> Look:
    """What a study shows, of each of several records too."""
    shares = (
        RecordShare(e.path.name, e.is_held_out, 100 * e.left / max(e.flow, 1e-300))
        for e in study.record_errors
    )
    return replace(look(study.replay), records=tuple(shares))


def _refuse_changed(path: Path, known: _Revision) -> None:
    """Where the file has other effects than a revision, somebody else has worked on it."""
    if [s.key for s in load(path).sections.added] != [s.key for s in known.sections]:
        raise RtidError(f"{path} has other effects than the page", "start `rtid ui` again")


class Desk(Reader):
    """One record and the stack of its revisions; every method is one job."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(progress)
        self._stack: list[_Revision] = []

    @classmethod
    def behind(cls, reader: Reader) -> Desk:
        """The desk of a record that was read."""
        desk = cls(reader._progress)
        desk._read = reader._read
        return desk

    def glance(self, file: Path, dbc: Path | None) -> Glance:
        """What is in a file that has no project."""
        self._progress(f"looking at {file.name}", 0.0)
        return glance(file, dbc)

    def judge(
        self,
        file: Path,
        dbc: Path | None,
        given: Given,
        roles: dict[str, str],
        more: Sequence[Path] = (),
    ) -> Judged:
        """The verdict of a file without a project, and the project that would be saved.

        more: further records that the project is of.
        """
        looked = quick(file, dbc, given, self._progress, roles, more)
        project = free_name(file.with_suffix(".toml"))
        if isinstance(looked, QuickPlant):
            kind, words = VERDICTS[looked.diagnosis.verdict]
            return Judged(kind, words, tuple(plant_lines(looked)), None, looked.found.text)
        if isinstance(looked, QuickRate):
            told, project_text = rate_lines(looked, project), looked.text_for(project)
        else:
            told, project_text = lines(looked, project), looked.text_for(project)
        kind, words = ("bad", "No verdict") if not looked.diagnosis else heading(looked.diagnosis)
        return Judged(kind, words, tuple(told)[:-2], project, project_text)

    def open(
        self, project: Path, trace: Path, sheet: Path | None, more: Sequence[Path] = ()
    ) -> Opened:
        """Read and learn; the model has the effects that the project file has.

        sheet: data sheet or exported map to hold beside the learned one; more: further records.
        """
        known, self._read = self._read, None
        study = Study(known[0] if known else project, [trace, *more], self._progress)
        if known and not study.records:  # of several it was but one
            vars(study)["read"] = known[1]
        _, read = study.replay, study.trace
        self._progress("simulating the pressures", 0.8)
        seen, first = _looked(study), _Revision(study, is_saved=True)
        self._stack = [first]
        return Opened(
            study.project.name,
            ", ".join(path.name for path in study.paths),
            read.duration_s,
            len(read.samples),
            {name: n for name, n in read.counters.items() if n},
            seen,
            first.sections,
            find_reference(study.project, sheet),
            study.project.model.chambers[0].unit,
        )

    def diagnose(self) -> RankedDiagnosis:
        """What is missing in the newest revision."""
        study = self._stack[-1].study
        study.rest()  # of what led to it
        said = study.diagnosis()
        ranking = ranked(study.diagnosed.result, said)
        study.rest()
        evidence = charts_of(study.evidence, study.remainder)
        study.rest()  # of what the evidence was made of
        return RankedDiagnosis(said, ranking, evidence)

    def tried(self, effect: str, where: str, reason: str) -> Addition:
        """What adding an effect would change; it is added to nothing but memory."""
        return _addition(self._with(effect, where, reason))

    def prepare(self, effect: str, where: str, reason: str) -> None:
        """Have ready what the page shows once an effect is added."""
        ready = self._with(effect, where, reason)
        ready.seen = ready.seen or _looked(ready.study)

    def add(self, effect: str, where: str, reason: str) -> Addition:
        """The newest revision with one effect more."""
        self._stack.append(self._with(effect, where, reason))
        return _addition(self._stack[-1])

    def look(self) -> Look:
        """What the newest revision shows, once."""
        last = self._stack[-1]
        self._progress("learning the maps again", 0.6)
        seen, last.seen = last.seen or _looked(last.study), None
        return seen

    def _with(self, effect: str, where: str, reason: str) -> _Revision:
        """The newest revision with one effect more, fitted once."""
        last, key = self._stack[-1], (effect, where, reason)
        if key not in last.ready:
            extension = last.study.tried(effect, where)
            against = "; ".join(extension.against)
            reason = f"forced: {against}" if against else reason
            against += f"; {extension.better}" if against and extension.better else ""
            study = with_effect(last.study, effect, where, reason)
            for rested in (last.study, study):
                rested.rest()
            section = study.project.sections.added[-1]
            last.ready[key] = _Revision(study, ADD, section, against)
        return last.ready[key]

    def back(self, kept: int) -> None:
        """Forget all revisions but the first ones."""
        del self._stack[max(kept, 1) :]

    def drop(self, effect: str, where: str) -> Addition:
        """The newest revision without one of its effects."""
        last = self._stack[-1]
        gone = next((s for s in last.sections if s.key == (effect, where)), None)
        if gone is None:
            raise RtidError(f"{effect} at {where} is not part of the model")
        study, errors = without(last.study, gone)
        self._stack.append(_Revision(study, DROP, gone.model_copy(update={"errors": errors})))
        return _addition(self._stack[-1])

    def save(self) -> Saved:
        """Write the changes of this session to the project file, each a line of its history."""
        study = self._stack[0].study
        path, trace = study.project.path, study.path.name
        changes = [r for r in self._stack if not r.is_saved]
        before = self._stack[self._stack.index(changes[0]) - 1] if changes else self._stack[-1]
        text = text_of(path)
        _refuse_changed(path, before)
        steps = []
        for r in changes:
            old, text = text, text_with(text, r.sections)
            if r.section is not None:
                steps.append((change_of(r.kind, r.section, old, r.section.reason, trace), text))
        if steps:
            write(path, steps)
        for r in changes:
            r.is_saved = True
        return Saved(f"wrote {path}; `{undo_command(path)}` takes the last change back")

    def take_back(self) -> str:
        """Take the newest revision, which is saved, out of the project file again."""
        path, last = self._stack[0].study.project.path, self._stack[-1]
        _refuse_changed(path, last)
        undo(path)
        self._stack.pop().is_saved = False  # it is ready to be added again
        return f"wrote {path}: as before the last change"

    def export(self, what: str) -> str:
        """Write a report beside the record."""
        if what != "report":
            raise RtidError(f"{what!r} is no format", "report; maps are released")
        study = self._stack[-1].study
        from rtid.tell.report_file import report  # noqa: PLC0415 - nothing else here needs Bokeh

        path = study.path.with_suffix(".report.html")
        report(load(study.project.path), study.path, path, self._progress)
        return f"wrote {path}: the story of the project file as it is saved"

    def release(self, wish: ReleaseWish) -> Released:
        """Write the maps of the newest revision as a controller or a tool takes them."""
        if wish.suffix not in formats():
            raise RtidError(f"{wish.suffix!r} is no format", f"one of {', '.join(formats())}")
        self._progress("laying out the tables", 0.5)
        last = self._stack[-1]
        return release(last.study, last.study.map, wish)

    def foretell(self, way: Way) -> Sending:
        """What sending the daemon's offer would change, as the records have it."""
        self._progress("looking at what would change", 0.5)
        return foretell(way)

    def send(self, way: Way, seen: Sending) -> str | Sending:
        """Send what was read, or ask anew where the controller tells something else."""
        self._progress("asking the controller", 0.0)
        return send(
            way, seen, lambda done, of: self._progress("sending the maps", done / max(of, 1))
        )
