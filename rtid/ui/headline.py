"""The lines above every view: which record, what goes on, and the verdict with the next step."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING

from rtid.project.history import ADD
from rtid.tell.html import button, text
from rtid.ui.shared import FAILED, STOPPED, Session, ShownRevision

if TYPE_CHECKING:
    from rtid.diagnose.report import Diagnosis

WELCOME = (
    "A file, what its signals are, sizes of the cylinder: then whether the data is good enough, "
    "what is missing in the model, and the project file for every other command."
)


def record_line(session: Session) -> str:
    """The machine, the record and what it holds."""
    opened = session.opened
    if opened is None:
        return _in_full(session.trace.name if session.trace else session.project.name)
    size = f"{opened.duration_s:.0f} s, {opened.samples:,} samples"
    return _in_full(f"{opened.project} · {opened.trace} · {size}")


def _in_full(words: str) -> str:
    """Words that a narrow page may cut, with all of them to be had by pointing at them."""
    return f'<span title="{text(words)}">{text(words)}</span>'


def work_line(session: Session) -> str:
    """What is being done, or what came of it."""
    if session.trouble[0]:
        message, remedy = session.trouble
        words = text(f"{message} {remedy}".strip())
        return (
            f'<span title="{words}"><span class="bad">{text(message)}</span> {text(remedy)}</span>'
        )
    if session.doing:
        stop = button("Stop", "stop", kind="link") if session.can_stop else ""
        return (
            f'<div class="acting">{_in_full(session.doing + " ...")}<progress max="1" '
            f'value="{session.share:.2f}" aria-label="progress"></progress>{stop}</div>'
        )
    return _in_full(session.note) if session.note else ""


def strip(session: Session) -> str:
    """The verdict in one sentence, and the button that follows from it."""
    last = session.last
    if session.arrival is not None:
        return f"<h1>What is in it?</h1><p>{WELCOME}</p>"
    if session.state == FAILED or session.trace is None:
        return _not_opened(session)
    if last is not None and last.section is not None and (last.told is None or last.note):
        return _changed(session, last)
    if last is None or last.told is None:
        return _undecided(session)
    return _decided(session, last, last.told.diagnosis)


def _not_opened(session: Session) -> str:
    """Why is told where the pictures would be; what was stopped may be asked for again."""
    if session.trouble != STOPPED:
        return ""
    again = button("Open the record", "diagnose", kind="main")
    return f"<h1>Stopped</h1><p>Nothing has been learned.</p>{again}"


def _undecided(session: Session) -> str:
    """Before there is a diagnosis, or where none came."""
    if session.last is not None and session.is_stopped:
        again = button("Look for what is missing", "diagnose", kind="main")
        return f"<h1>Not diagnosed</h1><p>It was stopped. The maps are learned.</p>{again}"
    if session.last is not None and session.trouble[0] and not session.doing:
        message, remedy = session.trouble
        words = f"{message}. {remedy}" if remedy else message
        return f'<h1 class="bad">Not diagnosed</h1><p>{text(words)}</p>'
    heading = "Looking for what is missing" if session.last else "Opening the record"
    return f"<h1>{heading}</h1><p>{_waiting(session)}</p>"


def _decided(session: Session, last: ShownRevision, diagnosis: Diagnosis) -> str:
    from rtid.effects.page import title  # noqa: PLC0415 - the live page needs none
    from rtid.tell.diagnosed import heading as heading_of  # noqa: PLC0415
    from rtid.tell.diagnosed import said  # noqa: PLC0415

    kind, heading = heading_of(diagnosis)
    words = said(diagnosis)
    offer = ""
    if session.named is not None:
        effect, where = session.named
        label = f"Add {title(effect).lower()}"
        offer = button(label, "add", kind="main", effect=effect, where=where)
    elif diagnosis.found and diagnosis.found[0].cannot_be_told_from:
        offer = button("Choose", "go", name="why")
    elif len(session.revisions) > 1 and not last.is_saved:
        offer = button("Save to project", "save", kind="main") + undo_button(last)
        words += " Next: save it, or undo." if diagnosis.verdict == "matches" else ""
    elif len(session.revisions) > 1:
        offer = button("To the maps", "go", kind="main", name="map") + undo_button(last)
    elif diagnosis.verdict == "matches":
        words += " Next: Map, to take the valves' maps along."
    return f'<h1 class="{kind}">{text(heading)}</h1><p>{text(words)}</p>{offer}'


def undo_button(last: ShownRevision | None, kind: str = "") -> str:
    """What takes a change back, out of the project file too where that has it; None: nothing."""
    is_in_file = last is not None and last.is_saved
    label = "Undo in the project" if is_in_file else "Undo"
    return button(label, "undo", kind=kind, off=last is None)


def _changed(session: Session, last: ShownRevision) -> str:
    """The change, before the new model is diagnosed, and where something speaks against it."""
    from rtid.effects.page import title  # noqa: PLC0415 - the live page needs none
    from rtid.ui.add_view import errors_of  # noqa: PLC0415

    section = last.section
    errors = [value for _, value, is_foretold in errors_of(session)[0] if not is_foretold]
    heading = "Added" if last.change == ADD else "Dropped"
    words = f"{title(section.effect)} at {section.where}. " if section else ""
    if isfinite(errors[-2]) and isfinite(errors[-1]):
        words += f"The error went from {errors[-2]:.2f} % to {errors[-1]:.2f} %. "
    if last.note:
        undo = undo_button(last, "main")
        return (
            f'<h1 class="open">{heading}, against the evidence</h1><p>{text(last.note)}</p>{undo}'
        )
    offer = undo_button(last)
    if session.is_stopped:
        offer = button("Look for what is missing", "diagnose", kind="main") + offer
    else:
        words += "Looking whether anything else is missing ..."
    return f'<h1 class="good">{heading}</h1><p>{text(words)}</p>{offer}'


def _waiting(session: Session) -> str:
    if session.last is None:
        return "Reading, learning the maps, simulating the pressures: some seconds."
    return (
        "Every known effect is held beside the model. Meanwhile: how well does it explain the "
        "record, and where does it fail?"
    )
