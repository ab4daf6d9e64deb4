"""What the worker does: open a record, say what is missing, add it, take it back, write files.

It holds the fits; what it returns is plain and small enough to be sent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from rtid.beside import learned_beside
from rtid.compare import Reference
from rtid.comparing import find_reference
from rtid.diagnose.clean import as_measured, usable
from rtid.diagnose.diagnosis import Result, search
from rtid.diagnose.extend import Extension, Standing, extend, stand
from rtid.diagnose.parts import Part
from rtid.diagnose.report import Diagnosis, diagnosis
from rtid.diagnose.trials import State
from rtid.diagnosing import added_parts, parts
from rtid.errors import RtidError
from rtid.estimator.solution import Solution
from rtid.mapfiles import provenance, write_map
from rtid.model import FloatArray, Model
from rtid.project import Project, load
from rtid.project.added import AddedSection, text_with
from rtid.project.history import ADD, DROP, text_of, write
from rtid.replay import Replay, replay
from rtid.report_story import Ranked, ranked
from rtid.reporting import report
from rtid.revised_sections import errors_between, extended
from rtid.revising import change_of
from rtid.ui.look import Look, look

FORMATS = ("csv", "json", "npz")
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Opened:
    """A record that was read and learned from."""

    project: str
    trace: str
    duration_s: float
    samples: int
    refused: dict[str, int]
    look: Look
    added: tuple[AddedSection, ...]
    reference: Reference | None


@dataclass(frozen=True)
class Told:
    """A diagnosis and the ranking of its candidates."""

    diagnosis: Diagnosis
    ranking: tuple[Ranked, ...]


@dataclass(frozen=True)
class Added:
    """An effect that was added: the new revision, its errors, what to say of it."""

    section: AddedSection
    sections: tuple[AddedSection, ...]
    look: Look
    note: str


@dataclass(frozen=True)
class Saved:
    """What was written to the project file."""

    note: str


@dataclass
class _Revision:
    """A model with its effects, and everything about it that is known so far."""

    sections: tuple[AddedSection, ...]
    look: Look
    solution: Solution
    kind: str = ""
    section: AddedSection | None = None
    is_saved: bool = False
    result: Result | None = None
    standing: Standing | None = None
    ready: dict[tuple[str, str], tuple[Extension, Replay, Look]] = field(default_factory=dict)


class Desk:
    """One record and the stack of its revisions; every method is one job."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._project: Project
        self._replay: Replay
        self._chunks: tuple[FloatArray, FloatArray]
        self._machine: Model
        self._stack: list[_Revision] = []

    def open(self, project: Path, trace: Path, sheet: Path | None) -> Opened:
        """Read and learn; the model has the effects that the project file has.

        sheet: data sheet or exported map to hold beside the learned one.
        """
        self._project = load(project)
        self._replay = replay(self._project, trace, lambda t, s: self._progress(t, 0.8 * s))
        read = self._replay.trace
        self._machine = replace(self._replay.model, own_effects=self._project.effects)
        self._chunks = parts(self._project, self._machine, read)
        self._progress("simulating the pressures", 0.8)
        sections, shown = self._project.sections.added, self._replay
        standing = None
        if sections:
            standing = stand(self._machine, *self._chunks, added_parts(self._project))
            shown = learned_beside(self._replay, standing.fit, [a.key for a in sections])
        solution = shown.fit.solution
        first = _Revision(sections, look(shown), solution, is_saved=True, standing=standing)
        self._stack = [first]
        return Opened(
            self._project.name,
            read.path.name,
            read.duration_s,
            len(read.samples),
            {name: n for name, n in read.counters.items() if n},
            first.look,
            sections,
            find_reference(self._project, sheet),
        )

    def diagnose(self) -> Told:
        """What is missing in the newest revision."""
        last = self._stack[-1]
        given = _parts(last.sections)
        last.result = search(self._machine, *self._chunks, self._progress, given)
        said = diagnosis(last.result)
        return Told(said, ranked(last.result, said))

    def prepare(self, effect: str, where: str) -> None:
        """Add an effect to nothing but memory, so that adding it takes no time."""
        self._extension(effect, where)

    def add(self, effect: str, where: str, reason: str) -> Added:
        """The newest revision with one effect more."""
        last = self._stack[-1]
        extension, result, seen = self._extension(effect, where)
        against = "; ".join(extension.against)
        reason = f"forced: {against}" if against else reason
        sections = extended(last.sections, extension, self._replay.trace.path.name, reason)
        solution = result.fit.solution
        self._stack.append(
            _Revision(sections, seen, solution, ADD, sections[-1], standing=extension.after)
        )
        return Added(sections[-1], sections, seen, against)

    def back(self) -> None:
        """Forget the newest revision."""
        if len(self._stack) > 1:
            self._stack.pop()

    def drop(self, effect: str, where: str) -> Added:
        """The newest revision without one of its effects."""
        last = self._stack[-1]
        gone = next((s for s in last.sections if s.key == (effect, where)), None)
        if gone is None:
            raise RtidError(f"{effect} at {where} is not part of the model")
        present = self._standing()
        kept = tuple(s for s in last.sections if s is not gone)
        self._progress("fitting without it", 0.2)
        after = stand(self._machine, *self._chunks, _parts(kept))
        errors = errors_between(present, after)
        keys = [a.key for a in kept]
        result = learned_beside(self._replay, after.fit, keys) if kept else self._replay
        seen, section = look(result), gone.model_copy(update={"errors": errors})
        solution = result.fit.solution
        self._stack.append(_Revision(kept, seen, solution, DROP, section, standing=after))
        return Added(section, kept, seen, "")

    def save(self) -> Saved:
        """Write the changes of this session to the project file, each a line of its history."""
        path, trace = self._project.path, self._replay.trace.path.name
        changes = [r for r in self._stack if not r.is_saved]
        before = self._stack[self._stack.index(changes[0]) - 1] if changes else self._stack[-1]
        text = text_of(path)
        if [s.key for s in load(path).sections.added] != [s.key for s in before.sections]:
            raise RtidError(
                f"{path} has other effects than when it was opened", "start `rtid ui` again"
            )
        steps = []
        for r in changes:
            old, text = text, text_with(text, r.sections)
            if r.section is not None:
                steps.append((change_of(r.kind, r.section, old, r.section.reason, trace), text))
        if steps:
            write(path, steps)
        for r in changes:
            r.is_saved = True
        return Saved(f"wrote {path}; `rtid undo -p {path.name}` takes the last change back")

    def export(self, what: str) -> str:
        """Write the map of the newest revision (csv, json, npz) or a report beside the record."""
        trace = self._replay.trace.path
        if what == "report":
            path = trace.with_suffix(".report.html")
            report(load(self._project.path), trace, path, self._progress)
            return f"wrote {path}: the story of the project file as it is saved"
        if what not in FORMATS:
            raise RtidError(f"{what!r} is no format", f"one of {', '.join(FORMATS)}")
        path, last = trace.with_suffix(f".map.{what}"), self._stack[-1]
        project, solution = self._project, last.solution
        write_map(
            path, last.look.flowmap, provenance(solution, project.name, project.digest, trace.name)
        )
        return f"wrote {path}"

    def _standing(self) -> Standing:
        """The newest revision on both parts, every candidate beside it."""
        last = self._stack[-1]
        if last.standing is None and last.result is not None:
            last.standing = Standing.of(self._state(last), last.result.first)
        if last.standing is None:
            self._progress("fitting", 0.1)
            last.standing = stand(self._machine, *self._chunks, _parts(last.sections))
        return last.standing

    def _state(self, revision: _Revision) -> State:
        model = as_measured(self._machine, self._chunks[0])
        chunk, held_out = (usable(model, part) for part in self._chunks)
        return State(model, chunk, held_out, self._progress, given=_parts(revision.sections))

    def _extension(self, effect: str, where: str) -> tuple[Extension, Replay, Look]:
        """The newest revision with one effect more, made once."""
        last, key = self._stack[-1], (effect, where)
        if key not in last.ready:
            present = self._standing()
            extension = _from_diagnosis(last.result, present, key)
            if extension is None:
                self._progress("fitting with the effect", 0.3)
                extension = extend(present, effect, where)
            self._progress("learning the maps again", 0.6)
            keys = [*(a.key for a in last.sections), key]
            result = learned_beside(self._replay, extension.after.fit, keys)
            last.ready[key] = extension, result, look(result)
        return last.ready[key]


def _from_diagnosis(
    result: Result | None, present: Standing, key: tuple[str, str]
) -> Extension | None:
    """The extension that the diagnosis has made already, where it added this effect alone."""
    if result is None or result.negligible or [f.key for f in result.found] != [key]:
        return None
    if result.found[0].alike:
        return None
    after = Standing.of(present.state, result.last)
    return Extension(key, result.found[0].gain, present, after, (), "")


def _parts(sections: tuple[AddedSection, ...]) -> tuple[Part, ...]:
    return tuple(
        Part(a.effect, a.where, {n: p.value for n, p in a.parameters.items()}, a.own_spools)
        for a in sections
    )
