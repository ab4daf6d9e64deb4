"""The table of the page's views: what each is called, where its class is, and what it consists of.

A view is a `PageView`: plots (roots), words (fragments), and what a user can do in it (actions).  A
package of its own brings one under its name in the entry points `rtid.views`; nothing else of the
page has to know it.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from bokeh.models import UIElement

    from rtid.study.look import Look
    from rtid.tell.charts.blocks import Key
    from rtid.ui.desk_views import Bench

PLUGINS = "rtid.views"  # entry points of other packages: name of the tab = a PageView
SAYS = "says"
Action = Callable[[dict[str, str]], None]


class PageView:
    """One view of an open record.

    places: from above to below, each a kind and, where there are several of it, a word: "tools"
    (buttons), "plot" (a root), "scroll" (words that may be long), "says" (the sentence below).
    The place "plot maps" of the view "where" is its root "maps", "tools" its fragment "tools".
    roots: the plots by the word of their place, made once; actions: what a button may ask for, by
    its `do`, called with its data as words.
    """

    places: ClassVar[tuple[str, ...]] = ("tools", "plot", "says")

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.roots: Mapping[str, UIElement] = {}
        self.actions: Mapping[str, Action] = {}

    @property
    def look(self) -> Look:
        """The newest revision of the model, held against the record."""
        return self.bench.look

    def refresh(self) -> None:
        """The session's revisions have changed."""

    def fragments(self) -> Mapping[str, str]:
        """HTML of the view's places, by their words."""
        return {}

    def mark(self, keys: Sequence[Key], words: str) -> None:
        """Blocks were pointed at, or those of a span of time; none: forget what is marked."""


@dataclass(frozen=True)
class ViewRow:
    """A row of the table; where: "module:Class", "" for what the page makes itself."""

    where: str
    places: tuple[str, ...] = PageView.places


VIEWS = {
    "compare": ViewRow("rtid.ui.compare_view:CompareView"),
    "where": ViewRow("rtid.ui.where_view:WhereView", ("tools", "plot maps", "plot time", "says")),
    "why": ViewRow("rtid.ui.why_view:WhyView", ("plot", "says", "scroll ranking", "scroll page")),
    "add": ViewRow("rtid.ui.add_view:AddView", ("scroll bars", "plot", "says")),
    "map": ViewRow("rtid.ui.map_view:MapView", ("tools", "tools release", "plot", "says")),
    "live": ViewRow("", ("scroll scope", "scroll health", "scroll planes", "scroll learning")),
}


def table() -> dict[str, ViewRow]:
    """All rows by name, those of other packages last, each under a name that is free."""
    rows = dict(VIEWS)
    for plugin in entry_points(group=PLUGINS):
        name = re.sub(r"\W", "_", plugin.name)
        while name in rows or not name.isidentifier():
            name = f"own_{name}"
        rows[name] = ViewRow(f"{plugin.module}:{plugin.attr}", _places(plugin.load))
    return rows


def _places(load: Callable[[], type[PageView]]) -> tuple[str, ...]:
    """Of a view of another package, and always one for the reason why it fails."""
    try:
        places = tuple(load().places)
    except Exception:  # whatever another package does, the page opens
        return (SAYS,)
    return places if SAYS in places else (*places, SAYS)


def made(row: ViewRow, bench: Bench) -> PageView:
    """The view of a row; one of another package that fails says so in its own place."""
    module, _, name = row.where.partition(":")
    if row in VIEWS.values():
        own: PageView = getattr(import_module(module), name)(bench)
        return own
    try:
        view: PageView = getattr(import_module(module), name)(bench)
        lost = _without_place(view.roots, row, "plot")
    except Exception as error:
        traceback.print_exception(error)
        return Failed(bench, _failed(row, error))
    return Failed(bench, lost) if lost else Outside(view, row)


def _failed(row: ViewRow, error: Exception) -> str:
    return f"{row.where} failed: {type(error).__name__}: {error}"


def _without_place(parts: Mapping[str, object], row: ViewRow, kind: str = "") -> str:
    """Why some parts of a row's view are not seen; "" where all are.  kind: of their places."""
    pairs = [place.partition(" ") for place in row.places]
    places = [word or k for k, _, word in pairs if k == kind or (not kind and k != "plot")]
    lost = sorted(set(parts) - set(places))
    known = ", ".join(places) or "none"
    return f"{row.where}: no place for {', '.join(lost)}; `places` has {known}" if lost else ""


class Failed(PageView):
    """What stands in the place of a view that cannot be made."""

    places = (SAYS,)

    def __init__(self, bench: Bench, reason: str) -> None:
        super().__init__(bench)
        self._reason = reason

    def fragments(self) -> Mapping[str, str]:
        """The reason."""
        return {SAYS: _text(self._reason)}


class Outside(PageView):
    """A view of another package: what fails in it is said in its own place, and stops no other."""

    def __init__(self, view: PageView, row: ViewRow) -> None:
        super().__init__(view.bench)
        self._view, self._row = view, row
        self._reason, self._told = "", ""  # what failed last, and what the terminal knows of
        self.roots = view.roots
        self.actions = {what: partial(self._try, do) for what, do in view.actions.items()}

    def refresh(self) -> None:
        """Of the view."""
        self._try(self._view.refresh)

    def fragments(self) -> Mapping[str, str]:
        """Those of the view; in place of its sentence, what failed since it did something last."""
        try:
            parts = dict(self._view.fragments())
            reason = self._reason or _without_place(parts, self._row)
        except Exception as error:
            parts, reason = {}, self._heard(error)
        return parts | {SAYS: _text(reason)} if reason else parts

    def mark(self, keys: Sequence[Key], words: str) -> None:
        """Of the view."""
        self._try(self._view.mark, keys, words)

    def _try(self, do: Callable[..., None], *given: Any) -> None:
        try:
            do(*given)
            self._reason = ""
        except Exception as error:
            self._reason = self._heard(error)

    def _heard(self, error: Exception) -> str:
        """What failed, in one line; where it did, once on the terminal."""
        reason = _failed(self._row, error)
        if reason != self._told:
            traceback.print_exception(error)
        self._told = reason
        return reason


def _text(words: str) -> str:
    from rtid.tell.html import text  # noqa: PLC0415 - rarely needed

    return text(words)


@dataclass(frozen=True)
class Place:
    """A place of a view; name: of its element, or of its root."""

    kind: str
    name: str


def places_of(view: str, row: ViewRow) -> list[Place]:
    """The places of a view, by the names that they have in the page."""
    pairs = [place.partition(" ") for place in row.places]
    return [Place(kind, f"{view}_{word or kind}") for kind, _, word in pairs]
