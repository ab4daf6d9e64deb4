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

from rtid.ui.fragments import changed, cover, parsed, static
from rtid.ui.live import Live
from rtid.ui.session import FAILED, Session
from rtid.ui.verdict import record_line, strip, work_line

silence(EMPTY_LAYOUT)  # a view that nobody has looked at yet
if TYPE_CHECKING:
    from rtid.ui.desk_views import DeskViews

PAUSE_MS = 1500  # between views that are made ahead
VIEWS = ("compare", "where", "why", "add", "map", "live")
ROOTS = ("compare", "where_maps", "where_time", "add", "map")


class Channel(DataModel):  # type: ignore[misc]
    """From the page: asked, a JSON message; to it: parts, HTML by place, and the view to show."""

    asked = String(default="")
    parts = Dict(String, String, default={})
    show = String(default="")


def build(doc: Document, session: Session, live: Live) -> None:
    """Fill the document of a page that was just opened."""
    Page(doc, session, live)


@cache
def _template() -> Template:
    """The page's frame; style and script are part of it."""
    return Environment(autoescape=False).from_string(static("page.html"))


class Page:
    """The views of one browser page; all of it runs on the server's event loop."""

    def __init__(self, doc: Document, session: Session, live: Live) -> None:
        self.doc, self.session, self.live = doc, session, live
        self._sent: dict[str, str] = {}
        self._is_open = False
        self._seen, self._beats, self._moves = "", 0, 0
        self._view = "live" if session.trace is None else "compare"
        self._channel = Channel(name="channel")
        self._roots = {name: column(name=name, sizing_mode="stretch_both") for name in ROOTS}
        self._desk: DeskViews | None = None
        self._channel.on_change("asked", lambda _attr, _old, new: self._take(parsed(new)))
        self._roots[ROOTS[0]].tags = [self._channel]  # it has nothing to draw, and goes along
        for root in self._roots.values():
            doc.add_root(root)
        doc.title = f"rtid: {(session.trace or session.project).name}"
        doc.template = _template()
        doc.template_variables.update(
            css=static("page.css", "plots.css"),
            js=static("plots.js", "page.js"),
            views=VIEWS,
            first=self._view,
        )
        session.listeners.append(self._heard)
        doc.on_session_destroyed(lambda _: session.listeners.remove(self._heard))
        self._refresh("looks")
        doc.add_periodic_callback(self._beat, 200)

    def _heard(self, what: str) -> None:
        """Something has changed: show it once the document may be touched."""
        self.doc.add_next_tick_callback(lambda: self._refresh(what))

    def _refresh(self, what: str) -> None:
        session = self.session
        if session.revisions and self._desk is None:
            from rtid.ui.desk_views import DeskViews  # noqa: PLC0415 - the live page needs none

            self._desk = DeskViews(session, self._roots, self._put)
            self._soon(self._prepare)
        if self._desk is not None:
            self._desk.refresh(what)
            self._desk.show(self._view)
        self._put(
            {
                "record": record_line(session),
                "work": work_line(session),
                "verdict": strip(session),
                "cover": self._cover(),
            }
        )

    def _soon(self, do: Callable[[], None]) -> None:
        self.doc.add_timeout_callback(do, PAUSE_MS)

    def _prepare(self) -> None:
        """Make the views that nobody looks at yet, one after the other."""
        if self._desk is not None and self._desk.prepare():
            self._soon(self._prepare)

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
        return cover("Learning from the record", [words], session.share)

    def _put(self, parts: dict[str, str]) -> None:
        """Send what has changed."""
        new = changed(self._sent, parts)
        if new:
            self._channel.parts = new if self._is_open else dict(self._sent)

    def _take(self, asked: dict[str, str]) -> None:
        """Do what the page asks."""
        what, self._is_open = asked.get("do", ""), True
        if what == "view":
            self._view = asked.get("name", "") if asked.get("name") in VIEWS else self._view
            self._refresh("view")
        elif what == "seen":
            self._seen = asked.get("number", "")
        elif what == "add":
            self._add(asked)
        elif what in SESSION_ACTIONS:
            SESSION_ACTIONS[what](self.session, asked)
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
        self._refresh("view")

    def _beat(self) -> None:
        """Five times a second: the live page, where it is looked at.

        The next update is made when the page has drawn the one before: a slow reader misses some,
        and nothing piles up.
        """
        if self._view == "live" and self._sent.get("seen", "") == self._seen:
            now = self.live.fragments()
            if any(self._sent.get(place) != html for place, html in now.items()):
                self._beats += 1
                self._put(now | {"seen": str(self._beats)})


SESSION_ACTIONS: dict[str, Callable[[Session, dict[str, str]], None]] = {
    "drop": lambda s, a: s.drop(a.get("effect", ""), a.get("where", "")),
    "undo": lambda s, a: s.undo(),
    "save": lambda s, a: s.save(),
    "export": lambda s, a: s.export(a.get("what", "")),
}
