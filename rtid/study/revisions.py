"""Change the model of a project: add a missing effect, drop one, undo, and tell the history.

Every change is fitted first and written last, so that nothing is written when anything fails.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from shlex import quote

from rtid.diagnose.extend import UNJUDGED, Extension, RefusedError
from rtid.diagnose.report import FoundEffect
from rtid.diagnose.standing import stand
from rtid.diagnose.verdict import AMBIGUOUS, MATCHES, MISSING
from rtid.effects import catalogue
from rtid.effects import effect as page_of
from rtid.effects.page import is_zero
from rtid.errors import RtidError, door
from rtid.plain import Progress, silent
from rtid.project import Project, load
from rtid.project.added import AddedSection, ErrorsSection, text_with
from rtid.project.history import ADD, DROP, UNDO, Change, digest, read, standing, text_of, write
from rtid.study.revised_sections import errors_between, extended, now, plain, refreshed, turned
from rtid.study.spans import added_parts
from rtid.study.study import Study
from rtid.study.zeroed import shifted
from rtid.trace.records import TracePaths
from rtid.units import nearest


@dataclass(frozen=True)
class Revised:
    """What a command did to a project: its changes, oldest first, and what the user should know.

    note: in plain words; counters: refusals of the trace by reason; is_written: False for a trial.
    """

    project: Path
    changes: tuple[Change, ...]
    note: str
    counters: dict[str, int]
    is_written: bool


@door
def add(
    project: str | Path,
    trace: TracePaths,
    effect: str = "",
    where: str = "",
    *,
    force: bool = False,
    dry_run: bool = False,
    reason: str = "",
    progress: Progress = silent,
) -> Revised:
    """Make an effect part of the model, or what the diagnosis names where none is named.

    Raises RefusedError, with the figures, where an effect does not deserve its place (unless
    force), and where the diagnosis names none or a set.
    """
    return added(
        Study(project, trace, progress), effect, where, force=force, dry_run=dry_run, reason=reason
    )


def added(
    study: Study,
    effect: str = "",
    where: str = "",
    *,
    force: bool = False,
    dry_run: bool = False,
    reason: str = "",
) -> Revised:
    """`add` to the project of a study: what it has fitted already is not fitted again."""
    project, trace = study.project.path, study.path.name
    text = _text(project, dry_run)
    keys, note = ([(effect, where)], "") if effect else _named(study)
    if effect:
        _refuse_unknown(effect, study.project)
    steps, counters = [], study.trace.counters
    for key in keys:
        extension = study.tried(*key)
        if not force:
            _refuse_useless(extension, bool(effect))
        study = with_effect(study, *key, reason or _why(effect, extension))
        note = note or (extension.better and f"{extension.better}." if effect else "")
        before, sections = text, study.project.sections.added
        text = text_with(text, sections)
        steps.append((change_of(ADD, sections[-1], before, sections[-1].reason, trace), text))
    return _done(project, steps, note, counters, dry_run)


def with_effect(study: Study, effect: str, where: str, reason: str) -> Study:
    """The study with one effect more in its model, in memory: what the page and `add` show.

    What is told of it is fitted anew: with the effect the grid may have to be finer.
    """
    extension = study.tried(effect, where)
    sections = extended(study.project.sections.added, extension, study.path.name, reason)
    if is_zero(effect):
        return shifted(study, extension.key[1], -_size(sections[-1]), sections)
    return study.having(extension.after, sections, is_final=False)


def _size(section: AddedSection) -> float:
    """Of an effect with one parameter, SI."""
    return next(iter(section.parameters.values())).value


def without(study: Study, gone: AddedSection) -> tuple[Study, ErrorsSection]:
    """The study without one of its effects, in memory, and what that costs."""
    kept = tuple(a for a in study.project.sections.added if a is not gone)
    if is_zero(gone.effect):
        other = shifted(study, gone.where, _size(gone), kept)
        return other, errors_between(study.standing, other.standing)
    rest = tuple(part for part in added_parts(study.project) if part.key != gone.key)
    before = study.standing
    study.progress("fitting without it", 0.5)
    its_own = study.project.effects
    after = stand(study.machine, *study.spans, rest, study.progress, suspects=its_own)
    return study.having(after, refreshed(kept, after)), errors_between(before, after)


@door
def drop(
    project: str | Path,
    effect: str,
    where: str = "",
    trace: str | Path | None = None,
    *,
    dry_run: bool = False,
    reason: str = "",
    progress: Progress = silent,
) -> Revised:
    """Take an effect out of the model; with a trace, also refit the rest and say what it costs."""
    project, trace = Path(project), None if trace is None else Path(trace)
    loaded = load(project)
    text = _text(project, dry_run)
    old = loaded.sections.added
    gone = _the_one(old, effect, where)
    kept = tuple(a for a in old if a is not gone)
    errors, counters = ErrorsSection(), dict[str, int]()
    if trace is not None:
        study, errors = without(Study(loaded, trace, progress), gone)
        kept, counters = study.project.sections.added, study.trace.counters
    change = change_of(DROP, gone, text, reason, trace.name if trace else "")
    change = replace(change, errors=plain(errors))
    return _done(project, [(change, text_with(text, kept))], "", counters, dry_run)


def undo_command(project: Path) -> str:
    """What a user types, or pastes, to take the last change back."""
    return f"rtid undo -p {quote(str(project))}"


@door
def undo(project: str | Path) -> Revised:
    """Take the last change back that is not taken back yet; the file becomes as it was before.

    Where somebody has edited the file since, that stays, and the effect alone goes out or in.
    """
    project = Path(project)
    text = text_of(project)
    changes = standing(read(project))
    if not changes:
        drop = "`rtid drop EFFECT` takes out what the file came with"
        remedy = drop if load(project).sections.added else "`rtid add` makes the first"
        raise RtidError(f"{project}: there is no change to undo", remedy, 4)
    last, note = changes[-1], ""
    restored = last.before
    if digest(text) not in (digest(restored), last.after_sha256):
        note = "The file was edited since; only the effect itself was taken back."
        restored = text_with(text, _reversed(load(project).sections.added, last))
    change = replace(
        last,
        change=UNDO,
        date=now().isoformat(),
        reason=f"takes change {last.number} back",
        errors=plain(turned(ErrorsSection.model_validate(last.errors))),
        undoes=last.number,
        before=text,
    )
    return _done(project, [(change, restored)], note, {}, dry_run=False)


def _text(project: Path, dry_run: bool) -> str:
    """The text of a project file, before the long work."""
    return project.read_bytes().decode() if dry_run else text_of(project)


def _refuse_unknown(effect: str, project: Project) -> None:
    """EffectError with near names for what is neither in the catalogue nor in the project."""
    if effect in catalogue():
        return
    if effect not in [user_effect.name for user_effect in project.all_effects]:
        page_of(effect)


def _refuse_useless(extension: Extension, is_chosen: bool) -> None:
    """What the user has chosen is held against all limits; what is named has passed most."""
    if (is_chosen and extension.against) or UNJUDGED in extension.against:
        effect, where = extension.key
        raise RefusedError(
            f"{effect} at {where} is refused: {'; '.join(extension.against)}",
            f"{extension.better}; ".lstrip("; ") + "--force adds it all the same",
        )


def _named(study: Study) -> tuple[list[tuple[str, str]], str]:
    """What the diagnosis names, to be added one after the other; a set of equals needs a choice."""
    said = study.diagnosis()
    if said.verdict == MATCHES:
        raise RefusedError("nothing to add: the model matches this trace")
    if said.verdict not in (MISSING, AMBIGUOUS):
        raise RefusedError(
            f"nothing to add: the diagnosis says {said.verdict}, and names no effect",
            "`rtid diagnose` says more; `rtid add EFFECT TRACE` tries one that you suspect",
        )
    clear = list(takewhile(lambda f: not f.cannot_be_told_from, said.found))
    if not clear:
        raise _choice(said.found[0])
    note = str(_choice(said.found[len(clear)])) if len(clear) < len(said.found) else ""
    return [(f.effect, f.where) for f in clear], note


def _choice(effect: FoundEffect) -> RefusedError:
    keys = [(effect.effect, effect.where), *effect.alike]
    names = [f"{name}:{where}" for name, where in keys]
    return RefusedError(
        f"this trace does not tell {', '.join(names[:-1])} and {names[-1]} apart",
        f"choose: rtid add {' | '.join(names)}; `rtid diagnose` names the motion that would tell",
    )


def _why(effect: str, extension: Extension) -> str:
    if extension.against and (effect or UNJUDGED in extension.against):
        return "forced: " + "; ".join(extension.against)
    by = "chosen by name" if effect else "named by the diagnosis"
    return f"{by}; chi2 fell by {extension.gain:.3g}"


def _the_one(sections: tuple[AddedSection, ...], effect: str, where: str) -> AddedSection:
    """The section of that effect; it must be told where there are several."""
    fit = [s for s in sections if s.effect == effect and where in ("", s.where)]
    if len(fit) == 1:
        return fit[0]
    names = [f"{s.effect}:{s.where}" for s in sections]
    wanted = f"{effect}:{where}" if where else effect
    if fit:
        raise RtidError(
            f"{effect} is in the model at several places", "name one: " + " | ".join(names), 2
        )
    raise RtidError(f"{wanted} is not part of the model", nearest(wanted, names), 2)


def _reversed(sections: tuple[AddedSection, ...], last: Change) -> tuple[AddedSection, ...]:
    """The sections without what was added, or with what was dropped."""
    kept = tuple(s for s in sections if s.key != (last.effect, last.where))
    if last.change == ADD:
        return kept
    return (*kept, AddedSection.model_validate_json(json.dumps(last.section)))


def change_of(kind: str, section: AddedSection, before: str, reason: str, trace: str) -> Change:
    """A line of the history, which `history.write` will number."""
    return Change(
        number=0,
        date=now().isoformat(),
        change=kind,
        effect=section.effect,
        where=section.where,
        reason=reason,
        trace=trace,
        section=section.model_dump(mode="json", exclude_none=True),
        errors=plain(section.errors),
        undoes=None,
        before=before,
        after_sha256="",
    )


def _done(
    project: Path,
    steps: list[tuple[Change, str]],
    note: str,
    counters: dict[str, int],
    dry_run: bool,
) -> Revised:
    changes = [change for change, _ in steps] if dry_run else write(project, steps)
    return Revised(project, tuple(changes), note, counters, not dry_run)
