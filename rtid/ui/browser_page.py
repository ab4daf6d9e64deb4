"""One browser page: its views, what it shows of the session, and what its user asks for."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

from bokeh.core.properties import Dict, String
from bokeh.core.validation import silence
from bokeh.core.validation.warnings import EMPTY_LAYOUT
from bokeh.document import Document
from bokeh.layouts import column
from bokeh.model import DataModel
from jinja2 import Environment, Template

from rtid.tell.html import button, changed, cover, parsed, static
from rtid.ui.arrival import DOES, fragments
from rtid.ui.curves import record
from rtid.ui.headline import record_line, strip, work_line
from rtid.ui.live_page import Live, Question
from rtid.ui.shared import FAILED, ROLE, Session
from rtid.ui.turns import Turns
from rtid.ui.views import VIEWS, places_of, table

silence(EMPTY_LAYOUT)  # a view that nobody has looked at yet
if TYPE_CHECKING:
    from rtid.ui.desk_views import DeskViews

PAUSE_MS = 1500  # between views that are made ahead


class Channel(DataModel):  # type: ignore[misc]
    """From the page: asked, a JSON message; to it: parts, HTML by place, and the view to show."""

    asked = String(default="")
    parts = Dict(String, String, default={})
    show = String(default="")


def build(doc: Document, session: Session, live: Live, turns: Turns) -> None:
    """Fill the document of a page that was just opened."""
    Page(doc, session, live, turns)


@cache
def _template() -> Template:
    """The page's frame; style and script are part of it."""
    return Environment(autoescape=False).from_string(static("page.html"))


class Page:
    """The views of one browser page; all of it runs on the server's event loop."""

    def __init__(self, doc: Document, session: Session, live: Live, turns: Turns) -> None:
        self.doc, self.session, self.live = doc, session, live
        context = doc.session_context
        self._browser = int(context.token_payload["browser"]) if context is not None else 0
        self._sent: dict[str, str] = {}
        self._is_open = self._is_gone = self._is_made = False
        self._turns, self._due = turns, set[str]()  # what is waiting for its turn
        self._seen, self._beats, self._moves = "", 0, 0
        self._is_accepting = False  # the user is asked whether that is meant
        is_live = session.trace is None and session.arrival is None
        self._view = "live" if is_live else "compare"
        self._channel = Channel(name="channel")
        self._rows = table()
        plots = [p for n, row in self._rows.items() for p in places_of(n, row) if p.kind == "plot"]
        self._roots = {p.name: column(name=p.name, sizing_mode="stretch_both") for p in plots}
        self._desk: DeskViews | None = None
        self._channel.on_change("asked", lambda _attr, _old, new: self._take(parsed(new)))
        next(iter(self._roots.values())).tags = [
            self._channel
        ]  # it has nothing to draw, and goes along
        for root in self._roots.values():
            doc.add_root(root)
        doc.title = f"rtid: {(session.trace or session.project).name}"
        doc.template = _template()
        doc.template_variables.update(
            css=static("page.css", "plots.css"),
            first_js=static("nonce.js"),
            js=static("plots.js", "page.js"),
            views={name: places_of(name, row) for name, row in self._rows.items()},
            own=VIEWS,
            first=self._view,
        )
        session.listeners.append(self._heard)
        session.join(self._browser)
        doc.on_session_destroyed(lambda _: self._gone())
        self._say()
        self._heard("looks")
        doc.add_periodic_callback(self._beat, 200)

    def _gone(self) -> None:
        self._is_gone = True
        self.session.listeners.remove(self._heard)
        self.session.leave(self._browser)

    def _heard(self, what: str) -> None:
        """Something has changed: show it when it is this page's turn."""
        if what not in self._due:
            self._due.add(what)
            self._take_turn(lambda: self._refresh_due(what))

    def _take_turn(self, do: Callable[[], None]) -> None:
        """In a turn of its own, once the document may be touched."""

        def turn() -> None:
            if not self._is_gone:
                self.doc.add_next_tick_callback(lambda: self._apart(do))

        self._turns.take(turn)

    async def _apart(self, do: Callable[[], None]) -> None:
        """Beside the loop: to make pictures takes longer than anybody else should wait.

        The document is locked meanwhile, and what is to be sent of it is sent by the loop.
        """
        self.doc.hold("collect")
        try:
            await self._turns.apart(do)
        finally:
            self.doc.unhold()
        if self._desk is not None and not self._is_made and not self._is_gone:
            self.doc.add_timeout_callback(lambda: self._take_turn(self._prepare), PAUSE_MS)
            self._is_made = True  # or asked for

    def _refresh_due(self, what: str) -> None:
        self._due.discard(what)
        self._refresh(what)

    def _refresh(self, what: str) -> None:
        session = self.session
        if session.revisions and self._desk is None:
            from rtid.ui.desk_views import DeskViews  # noqa: PLC0415 - the live page needs none

            self._desk = DeskViews(session, self._rows, self._roots, self._put)
        if self._desk is not None and what != ROLE:
            self._desk.refresh(what)
            self._desk.show(self._view)
            self._is_made = self._is_made and what not in ("looks", "told")
        self._say()

    def _say(self) -> None:
        """The words around the views."""
        session = self.session
        self._put(
            {
                "record": record_line(session),
                "work": work_line(session) + self._role(),
                "verdict": strip(session),
                "cover": self._cover(),
            }
            | self._arriving()
        )

    def _arriving(self) -> dict[str, str]:
        """The door, while there is no project."""
        session = self.session
        if session.arrival is None or self._view == "live":
            return {}
        return fragments(session, session.arrival)

    @property
    def _follows(self) -> bool:
        """Whether another browser works on the record."""
        return self.session.writer not in (None, self._browser)

    def _role(self) -> str:
        """Who works and who follows, where there are several browsers."""
        others = len(self.session.pages) - 1
        if self._follows:
            words, offer = "following another browser", button("Take over", "take_over")
        elif others > 0:
            words, offer = f"{others} following", ""
        else:
            return ""
        return f'<span class="acting role"><span title="{words}">{words}</span>{offer}</span>'

    def _prepare(self) -> None:
        """Make a view that nobody looks at yet."""
        self._is_made = self._desk is None or not self._desk.prepare()

    def _cover(self) -> str:
        """What stands in the place of the views while there is nothing to show in them."""
        session = self.session
        if self._view == "live" or session.revisions:
            return ""
        if session.state == FAILED:
            message, remedy = session.trouble
            return cover("This record cannot be shown", [message, remedy])
        if session.trace is None:
            command = f"rtid ui {session.project} TRACE"
            return cover("No record is open", [f"Open one with: {command}"])
        words = f"{session.trace.name}: {session.doing} ..."
        return cover("Learning from the record", [words], session.share) + record(session.curves)

    def _put(self, parts: dict[str, str]) -> None:
        """Send what has changed."""
        new = changed(self._sent, parts)
        if new:
            self._channel.parts = new if self._is_open else dict(self._sent)

    def _take(self, asked: dict[str, str]) -> None:
        """Do what the page asks."""
        what, self._is_open, session = asked.get("do", ""), True, self.session
        if what == "view":
            self._view = asked.get("name", "") if asked.get("name") in self._rows else self._view
            self._say()
            self._heard("view")
        elif what == "seen":
            self._seen = asked.get("number", "")
        elif what in DOES:
            if session.arrival is not None and not self._follows:
                DOES[what](session, session.arrival, asked)
        elif what == "take_over":
            self.session.take_over(self._browser)
            self._say()
        elif what in ("add", "release", *SESSION_ACTIONS, *LIVE_ACTIONS) and self._follows:
            self._say()
        elif what == "add":
            self._add(asked)
        elif what in SESSION_ACTIONS:
            SESSION_ACTIONS[what](self.session, asked)
        elif what in LIVE_ACTIONS:
            LIVE_ACTIONS[what](self, asked)
        elif self._desk is not None:
            self._desk.take(what, asked)

    def _add(self, asked: dict[str, str]) -> None:
        """Add what is asked for, or what is named, and show where the error falls."""
        named = self.session.named
        if "effect" in asked:
            self.session.add(asked["effect"], asked.get("where", ""))
        elif named is not None:
            self.session.add(*named)
        else:
            return
        self._view, self._moves = "add", self._moves + 1
        self._channel.show = f"add {self._moves}"
        self._heard("view")

    def ask_accept(self) -> None:
        """Ask whether the changed machine shall be accepted."""
        self._is_accepting = True
        self.session.not_sent()

    def ask_apply(self) -> None:
        """Ask whether the maps shall be sent."""
        self._is_accepting = False
        self.session.foretell()

    def go_ahead(self, about: str) -> None:
        """Do what was asked about."""
        if about == "accept" and self._is_accepting:
            self.session.say(self.live.accept())
        elif about == "apply":
            self.session.send()
        self._is_accepting = False

    def leave_it(self) -> None:
        """Do nothing of what was asked about."""
        self._is_accepting = False
        self.session.not_sent()

    @property
    def _question(self) -> Question | None:
        """What waits for a yes."""
        sending = self.session.sending
        if sending is not None:
            return Question("apply", sending.html(), sending.may_go)
        return Question("accept", f"<p>{ACCEPT}</p>") if self._is_accepting else None

    def _beat(self) -> None:
        """Five times a second: the live page, where it is looked at.

        The next update is made when the page has drawn the one before: a slow reader misses some,
        and nothing piles up.
        """
        self.live.hear()
        if self._view == "live" and self._sent.get("seen", "") == self._seen:
            now = self.live.fragments(self._question, self._follows)
            if any(self._sent.get(place) != html for place, html in now.items()):
                self._beats += 1
                self._put(now | {"seen": str(self._beats)})


SESSION_ACTIONS: dict[str, Callable[[Session, dict[str, str]], None]] = {
    "drop": lambda s, a: s.drop(a.get("effect", ""), a.get("where", "")),
    "undo": lambda s, a: s.undo(),
    "stop": lambda s, a: s.stop(),
    "diagnose": lambda s, a: s.diagnose(),
    "save": lambda s, a: s.save(),
    "export": lambda s, a: s.export(a.get("what", "")),
}
ACCEPT = (
    "Take the machine as it is now for the new normal? What was learned before is kept aside, and "
    "the maps begin anew with the samples since the change."
)
LIVE_ACTIONS: dict[str, Callable[[Page, dict[str, str]], None]] = {
    "accept": lambda page, a: page.ask_accept(),
    "apply": lambda page, a: page.ask_apply(),
    "sure": lambda page, a: page.go_ahead(a.get("name", "")),
    "not_sure": lambda page, a: page.leave_it(),
    "days": lambda page, a: page.live.compare(a.get("name", "")),
    "look": lambda page, a: page.session.look_at(a.get("name", "")),
}
