"""What all pages show: the record, the stack of revisions, what was diagnosed, what is going on.

Pages listen; the worker's answers arrive here.  Nothing is written to the project file until the
user asks for it.  Of several browsers one works on the record, the others follow what it does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rtid.errors import RtidError
from rtid.plain import Key
from rtid.project.added import AddedSection
from rtid.ui.arrival import Arrival, choose
from rtid.ui.release_form import Released, ReleaseWish
from rtid.ui.sending import Sending, Way
from rtid.ui.worker import Worker, ignore
from rtid.units import show_flow_as

if TYPE_CHECKING:
    from rtid.study.look import Look
    from rtid.trace.glance import Curve
    from rtid.ui.desk import Addition, Opened, RankedDiagnosis, Saved

Listener = Callable[[str], None]
LOADING, READY, FAILED = "loading", "ready", "failed"
STOPPABLE = (
    *("read", "open", "diagnose", "tried", "prepare", "add", "drop", "look"),
    *("glance", "judge"),
)
STOPPED = "Stopped", "nothing has been learned from this record"
NAMED = "named by the diagnosis"  # why an effect was added
ROLE = "role"  # what pages hear when another browser comes, goes or takes over


@dataclass
class ShownRevision:
    """A model of the stack; change: what led to it, "" for the first.

    look: where it is not `is_seen` yet, that of the model before; ready: additions that are fitted.
    """

    look: Look
    sections: tuple[AddedSection, ...]
    change: str = ""
    section: AddedSection | None = None
    told: RankedDiagnosis | None = None
    note: str = ""  # what speaks against the change
    is_saved: bool = False
    is_seen: bool = True
    ready: dict[Key, Addition] = field(default_factory=dict)


@dataclass
class Session:
    """One record on one desk; every method returns at once."""

    project: Path
    trace: Path | None
    worker: Worker
    sheet: Path | None = None
    more: tuple[Path, ...] = ()  # further records of the same fit
    state: str = LOADING
    doing: str = "starting"
    share: float = 0.0
    trouble: tuple[str, str] = ("", "")
    note: str = ""
    curves: tuple[Curve, ...] = ()  # of the record, before anything is learned from it
    opened: Opened | None = None
    revisions: list[ShownRevision] = field(default_factory=list)
    listeners: list[Listener] = field(default_factory=list)
    pages: Counter[int] = field(default_factory=Counter)  # open ones by browser
    writer: int | None = None  # the browser that works on the record
    arrival: Arrival | None = None  # before there is a project
    released: Released | None = None  # the last that was written, see `offered`
    folder: Path | None = None  # in which a daemon keeps its state
    test_bus: bool = False  # maps may be sent over a bus that anybody may write to
    sending: Sending | None = None  # waits for a yes
    is_stopped: bool = False  # what was being done, by the user
    _is_adding: bool = False
    _released_of: ShownRevision | None = None

    def open(self) -> None:
        """Read the record."""
        if self.arrival is not None:
            self.state, self.doing = READY, ""
            if self.arrival.file is not None:
                choose(self, self.arrival, self.arrival.file)
            return
        if self.trace is None:
            self.state, self.doing = READY, ""
            return
        self.state, self.trouble = LOADING, ("", "")
        self.ask("read", self.project, self.trace, then=self._read, failed=self._not_opened)

    def begin(self, project: Path, text: str, trace: Path) -> None:
        """Write the project of a file that had none, and open both."""
        try:
            with project.open("x", encoding="utf-8") as file:
                file.write(text)
        except OSError as error:
            raise RtidError(f"{project}: {error.strerror}", "is the folder writable?") from None
        self.project, self.trace, self.arrival = project, trace, None
        self.state, self.doing = LOADING, "starting"
        self.open()
        self.note = f"wrote {project}"

    def join(self, browser: int) -> None:
        """A page was opened; the first browser works, the others follow."""
        is_new = browser not in self.pages
        self.pages[browser] += 1
        if self.writer is None:
            self.writer = browser
        if is_new:
            self.tell(ROLE)

    def leave(self, browser: int) -> None:
        """A page was closed; with the last one of the writer another browser takes its place."""
        self.pages[browser] -= 1
        self.pages = +self.pages
        if browser in self.pages:
            return
        if self.writer == browser:
            self.writer = min(self.pages, default=None)
        self.tell(ROLE)

    def take_over(self, browser: int) -> None:
        """Work from this browser from now on."""
        self.writer = browser
        self.tell(ROLE)

    @property
    def last(self) -> ShownRevision | None:
        """The newest revision."""
        return self.revisions[-1] if self.revisions else None

    @property
    def seen(self) -> list[ShownRevision]:
        """The revisions that can be shown: the newest one may still be learned."""
        return [revision for revision in self.revisions if revision.is_seen]

    @property
    def named(self) -> Key | None:
        """The one effect that the newest diagnosis names first; None: none, or a set."""
        ranked = self.last.told if self.last else None
        effects = ranked.diagnosis.found if ranked else ()
        if not effects or effects[0].cannot_be_told_from or self._is_adding:
            return None
        return effects[0].effect, effects[0].where

    def add(self, effect: str, where: str) -> None:
        """Make an effect part of the model; one that is fitted already is told at once."""
        last = self.last
        named = last.told.diagnosis.found if last and last.told else ()
        is_named = (effect, where) in [(f.effect, f.where) for f in named]
        asked = "add", effect, where, NAMED if is_named else "chosen by name"
        ready = last.ready.get((effect, where)) if last else None
        if ready is not None:
            self.worker.ask(*asked, then=ignore, failed=self._not_looked)
            self._added("add")(ready)
            return
        self.worker.forget("prepare")  # that would be waited for, and can be made afterwards
        if self.worker.is_busy:
            self.doing = "finishing what was begun"
        self._is_adding = True
        self.ask(*asked, then=self._added("add"))

    def drop(self, effect: str, where: str) -> None:
        """Take an effect out of the model."""
        self.ask("drop", effect, where, then=self._added("drop"))

    def undo(self) -> None:
        """Take the last change of this session back; the page shows so before the worker knows.

        One that is saved goes out of the project file too, as with `rtid undo`.
        """
        if self._is_adding:
            self.stop()
        elif len(self.revisions) > 1:
            self._forget()
            gone = self.revisions.pop()
            if gone.is_saved:
                failed = partial(self._not_taken_back, len(self.revisions), gone)
                self.ask("take_back", then=self.say, failed=failed)
            else:
                self._step_back()
            self.tell("state")  # words first: pictures take longer
            self.tell("looks")
            self._diagnose()

    def _not_taken_back(self, at: int, gone: ShownRevision, error: RtidError) -> None:
        self.revisions.insert(at, gone)
        self._failed(error)
        self.tell("looks")

    def stop(self) -> None:
        """Wait no longer for what is being done; what there was before stays."""
        self._forget()
        self.is_stopped = True
        if not self.revisions:
            self.state, self.trouble = FAILED, STOPPED
        else:
            self.revisions = self.seen
            self._step_back()
        self.tell("state")

    @property
    def can_stop(self) -> bool:
        """Whether what is being done may be left alone in the middle."""
        return self.worker.is_doing(*STOPPABLE)

    def _forget(self) -> None:
        self.worker.forget(*STOPPABLE)
        self.doing, self.share, self._is_adding = "", 0.0, False

    def _step_back(self) -> None:
        """Let the worker forget what the page no longer has, when it comes to it."""
        self.worker.ask("back", len(self.revisions), then=ignore, failed=ignore)

    def diagnose(self) -> None:
        """Look for what is missing, where that was stopped; or open the record that was not."""
        if self.revisions:
            self._diagnose()
        elif self.state == FAILED:
            self.open()

    def save(self) -> None:
        """Write the changes of this session to the project file, once they are learned."""
        if self.seen == self.revisions:
            self.ask("save", then=self._saved)

    def export(self, what: str) -> None:
        """Write a report beside the record."""
        self.ask("export", what, then=self.say)

    @property
    def offered(self) -> Released | None:
        """What can be taken from the page: released of the model that it shows, not of one before.

        The files stay where they were written; whoever signs the sheet shall sign the page's maps.
        """
        return self.released if self._released_of is self.last else None

    def release(self, wish: ReleaseWish) -> None:
        """Write the maps as a controller or a tool takes them, to be taken from the page."""
        revision = self.last

        def done(released: Released) -> None:
            self.released, self._released_of = released, revision
            self.tell("looks")
            self.say(f"wrote {released.files[0]}")

        self.ask("release", wish, then=done)

    def foretell(self) -> None:
        """Ask whether the daemon's offer shall be sent, with what would change."""
        self.sending = None
        self.ask("foretell", self._way, then=self._foretold)

    def send(self) -> None:
        """Send what was asked about, as `rtid apply` does."""
        seen, self.sending = self.sending, None
        if seen is not None and seen.may_go:
            self.ask("send", self._way, seen, then=self._sent)

    def not_sent(self) -> None:
        """Leave the controller as it is."""
        self.sending = None

    @property
    def _way(self) -> Way:
        return Way(self.project, self.folder, self.test_bus)

    def _foretold(self, foretold: Sending) -> None:
        self.sending = foretold
        self.tell("state")

    def _sent(self, outcome: str | Sending) -> None:
        if isinstance(outcome, str):
            self.say(outcome)
        else:
            self._foretold(outcome)
            self.say("nothing was sent: the controller tells something else than the records")

    def look_at(self, name: str) -> None:
        """Open the recorded seconds around an alarm."""
        recorded = sorted(Path(name).glob("*.blf"))
        if self.trace is None and recorded:
            self.trace, self.state = recorded[:2][-1], LOADING  # that it came in
            self.open()

    def tell(self, what: str) -> None:
        """Let all pages know that something has changed: "state", "looks", "told", ROLE."""
        for listener in list(self.listeners):
            listener(what)

    def ask(
        self,
        method: str,
        *arguments: object,
        then: Callable[..., None],
        failed: Callable[[RtidError], None] | None = None,
    ) -> None:
        """Give the worker a job, and tell all pages how it goes."""

        def done(result: object) -> None:
            self.doing, self.share, self.trouble = "", 0.0, ("", "")
            then(result)

        self.note, self.trouble, self.is_stopped = "", ("", ""), False
        self.doing, self.share = self.doing or "working", 0.0
        self.worker.ask(
            method, *arguments, then=done, failed=failed or self._failed, progress=self._progress
        )
        self.tell("state")

    def _progress(self, text: str, share: float) -> None:
        self.doing, self.share = text, share
        self.tell("state")

    def _failed(self, error: RtidError) -> None:
        self.doing, self.trouble, self._is_adding = "", (str(error), error.remedy), False
        self.tell("state")

    def _not_opened(self, error: RtidError) -> None:
        self.state = FAILED
        self._failed(error)

    def _read(self, curves: tuple[Curve, ...]) -> None:
        self.curves, known = curves, (self.project, self.trace, self.sheet, self.more)
        self.ask("open", *known, then=self._opened, failed=self._not_opened)

    def _opened(self, opened: Opened) -> None:
        self.state, self.opened, self.curves = READY, opened, ()
        # the project was read in the worker, another process: charts and words are made here
        show_flow_as(opened.flow_unit)
        self.revisions = [ShownRevision(opened.look, opened.added, is_saved=True)]
        self.tell("looks")
        self._diagnose()

    def _diagnose(self) -> None:
        revision = self.last
        if revision is None or revision.told is not None:
            return

        def words(result: RankedDiagnosis) -> None:
            revision.told = result
            self.tell("told")
            self._prepare(revision)

        self.ask("diagnose", then=words)

    def _prepare(self, revision: ShownRevision) -> None:
        """Have the next revision ready before the user asks for it."""
        effects = revision.told.diagnosis.found if revision.told else ()
        if effects and revision is self.last:
            key = effects[0].effect, effects[0].where

            def ready(addition: Addition) -> None:
                revision.ready[key] = addition

            self.worker.ask("tried", *key, NAMED, then=ready, failed=ignore)
            self.worker.ask("prepare", *key, NAMED, then=ignore, failed=ignore)

    def _added(self, change: str) -> Callable[[Addition], None]:
        def added(result: Addition) -> None:
            shown = self.revisions[-1].look
            revision = ShownRevision(
                shown, result.sections, change, result.section, note=result.note, is_seen=False
            )
            self.revisions.append(revision)
            self._is_adding = False
            self.ask("look", then=partial(self._looked, revision), failed=self._not_looked)

        return added

    def _looked(self, revision: ShownRevision, look: Look) -> None:
        revision.look, revision.is_seen = look, True
        self.tell("looks")
        self._diagnose()

    def _not_looked(self, error: RtidError) -> None:
        self.revisions = self.seen
        self._step_back()
        self._failed(error)

    def _saved(self, saved: Saved) -> None:
        for revision in self.revisions:
            revision.is_saved = True
        self.say(saved.note)

    def say(self, note: str) -> None:
        """Tell all pages what came of something."""
        self.note = note
        self.tell("state")
