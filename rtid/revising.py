"""Change the model of a project: add a missing effect, drop one, undo, and tell the history.

Every change is fitted first and written last, so that nothing is written when anything fails.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path

from rtid.diagnose.extend import UNJUDGED, Extension, RefusedError, Standing, extend, stand
from rtid.diagnose.trials import Found
from rtid.diagnose.verdict import AMBIGUOUS, MATCHES, MISSING
from rtid.diagnosing import added_parts, diagnose_trace, parts, trace_of
from rtid.effects import effect as page_of
from rtid.errors import RtidError
from rtid.project import Project, load
from rtid.project.added import AddedSection, ErrorsSection, text_with
from rtid.project.history import ADD, DROP, UNDO, Change, digest, read, standing, text_of, write
from rtid.replay import model_for
from rtid.revised_sections import errors_between, extended, now, plain, refreshed, turned
from rtid.units import nearest

Progress = Callable[[str, float], None]


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


def _silent(_what: str, _share: float) -> None:
    pass


def add(
    project: Path,
    trace: Path,
    effect: str = "",
    where: str = "",
    *,
    force: bool = False,
    dry_run: bool = False,
    reason: str = "",
    progress: Progress = _silent,
) -> Revised:
    """Make an effect part of the model, or what the diagnosis names where none is named.

    Raises RefusedError, with the figures, where an effect does not deserve its place (unless
    force), and where the diagnosis names none or a set.
    """
    text, loaded = _opened(project, dry_run)
    if effect:
        _refuse_unknown(effect, loaded)
        present, counters = _begin(loaded, trace, progress)
        progress("fitting with the effect", 0.5)
        extensions = [extend(present, effect, where)]
        note = extensions[0].better and f"{extensions[0].better}."
        if not force:
            _refuse_useless(extensions[0])
    else:
        extensions, note, counters = _named(loaded, trace, force, progress)
    steps, sections = [], loaded.sections.added
    for extension in extensions:
        sections = extended(sections, extension, trace.name, reason or _why(effect, extension))
        before, text = text, text_with(text, sections)
        steps.append((change_of(ADD, sections[-1], before, sections[-1].reason, trace.name), text))
    return _done(project, steps, note, counters, dry_run)


def drop(
    project: Path,
    effect: str,
    where: str = "",
    trace: Path | None = None,
    *,
    dry_run: bool = False,
    reason: str = "",
    progress: Progress = _silent,
) -> Revised:
    """Take an effect out of the model; with a trace, also refit the rest and say what it costs."""
    text, loaded = _opened(project, dry_run)
    old = loaded.sections.added
    gone = _the_one(old, effect, where)
    kept = tuple(a for a in old if a is not gone)
    errors, counters = ErrorsSection(), dict[str, int]()
    if trace is not None:
        present, counters = _begin(loaded, trace, progress)
        state, left = present.state, tuple(p for p in added_parts(loaded) if p.key != gone.key)
        after = stand(state.model, state.chunk, state.held_out, left, progress)
        errors, kept = errors_between(present, after), refreshed(kept, after)
    change = change_of(DROP, gone, text, reason, trace.name if trace else "")
    change = replace(change, errors=plain(errors))
    return _done(project, [(change, text_with(text, kept))], "", counters, dry_run)


def undo(project: Path) -> Revised:
    """Take the last change back that is not taken back yet; the file becomes as it was before.

    Where somebody has edited the file since, that stays, and the effect alone goes out or in.
    """
    text = text_of(project)
    changes = standing(read(project))
    if not changes:
        raise RtidError(f"{project}: there is no change to undo", "", 4)
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


def history(project: Path) -> list[Change]:
    """All changes of a project, oldest first."""
    if not project.is_file():
        raise RtidError(f"{project}: no such file", "name a project file", 2)
    return read(project)


def _opened(project: Path, dry_run: bool) -> tuple[str, Project]:
    """Text and content of a project file, before the long work."""
    loaded = load(project)
    return (project.read_bytes().decode() if dry_run else text_of(project)), loaded


def _refuse_unknown(effect: str, project: Project) -> None:
    """EffectError with near names for what is neither in the catalogue nor in the project."""
    if effect not in [own.name for own in project.effects]:
        page_of(effect)


def _begin(project: Project, trace: Path, progress: Progress) -> tuple[Standing, dict[str, int]]:
    progress("reading", 0.0)
    read_ = trace_of(project, trace)
    model = model_for(project, read_.samples)
    chunks = parts(project, model, read_)
    progress("fitting", 0.1)
    return stand(model, *chunks, added_parts(project), progress), read_.counters


def _refuse_useless(extension: Extension) -> None:
    if extension.against:
        effect, where = extension.key
        raise RefusedError(
            f"{effect} at {where} is refused: {'; '.join(extension.against)}",
            f"{extension.better}; ".lstrip("; ") + "--force adds it all the same",
        )


def _named(
    project: Project, trace: Path, force: bool, progress: Progress
) -> tuple[list[Extension], str, dict[str, int]]:
    """What the diagnosis names, added one after the other; a set of equals needs a choice."""
    found = diagnose_trace(project, trace, lambda what, share: progress(what, 0.7 * share))
    result, verdict = found.result, found.diagnosis.verdict
    if verdict == MATCHES:
        raise RefusedError("nothing to add: the model matches this trace")
    if verdict not in (MISSING, AMBIGUOUS):
        raise RefusedError(
            f"nothing to add: the diagnosis says {verdict}, and names no effect",
            "`rtid diagnose` says more; `rtid add EFFECT TRACE` tries one that you suspect",
        )
    clear = list(takewhile(lambda f: not f.alike, result.found))
    if not clear:
        raise _choice(result.found[0])
    note = str(_choice(result.found[len(clear)])) if len(clear) < len(result.found) else ""
    model, chunks = found.model, parts(project, found.model, found.trace)
    present = stand(model, *chunks, added_parts(project))
    extensions: list[Extension] = []
    for f in clear:
        progress(f"adding {f.key[0]}", 0.7 + 0.3 * len(extensions) / len(clear))
        extensions.append(extend(present, *f.key))
        if UNJUDGED in extensions[-1].against and not force:
            _refuse_useless(extensions[-1])
        present = extensions[-1].after
    return extensions, note, found.trace.counters


def _choice(found: Found) -> RefusedError:
    names = [f"{effect}:{where}" for effect, where in (found.key, *found.alike)]
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
