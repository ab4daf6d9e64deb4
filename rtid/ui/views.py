"""The table of the page's views: what each is called, where its class is, and what it consists of.

A view is a `PageView`: plots (roots), words (fragments), and what a user can do in it (actions).  A
package of its own brings one under its name in the entry points `rtid.views`; nothing else of the
page has to know it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from bokeh.models import UIElement

    from rtid.study.look import Look
    from rtid.tell.charts.blocks import Key
    from rtid.ui.desk_views import Bench

PLUGINS = "rtid.views"
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
    """All rows by name, those of other packages last."""
    more = {
        plugin.name: ViewRow(f"{plugin.module}:{plugin.attr}", _places(plugin.load))
        for plugin in entry_points(group=PLUGINS)
        if plugin.name.isidentifier() and plugin.name not in VIEWS
    }
    return VIEWS | more


def _places(load: Callable[[], type[PageView]]) -> tuple[str, ...]:
    """Of a view of another package; one that cannot be loaded has room for the reason."""
    try:
        return load().places
    except Exception:  # whatever another package does, the page opens
        return ("says",)


def made(row: ViewRow, bench: Bench) -> PageView:
    """The view of a row; one of another package that fails says so in its own place."""
    try:
        module, _, name = row.where.partition(":")
        view: PageView = getattr(import_module(module), name)(bench)
    except Exception as error:
        if row in VIEWS.values():
            raise
        return Failed(bench, f"{row.where} failed: {type(error).__name__}: {error}")
    return view


class Failed(PageView):
    """What stands in the place of a view that cannot be made."""

    places = ("says",)

    def __init__(self, bench: Bench, reason: str) -> None:
        super().__init__(bench)
        self._reason = reason

    def fragments(self) -> Mapping[str, str]:
        """The reason."""
        from rtid.tell.html import text  # noqa: PLC0415 - rarely needed

        return {"says": text(self._reason)}


@dataclass(frozen=True)
class Place:
    """A place of a view; name: of its element, or of its root."""

    kind: str
    name: str


def places_of(view: str, row: ViewRow) -> list[Place]:
    """The places of a view, by the names that they have in the page."""
    pairs = [place.partition(" ") for place in row.places]
    return [Place(kind, f"{view}_{word or kind}") for kind, _, word in pairs]
