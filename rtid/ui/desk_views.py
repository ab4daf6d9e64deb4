"""The views of a record: made when they are first looked at, and what a user does in them."""

from __future__ import annotations

from collections.abc import Callable

from bokeh.models import Column, UIElement

from rtid.compare import NoSuchBlockError
from rtid.compare.places import blocks_in_span, spans_of_block
from rtid.report_words import text
from rtid.ui import add_view, why_view
from rtid.ui.add_view import AddView
from rtid.ui.blocks import Key
from rtid.ui.compare_view import RUNS, CompareView
from rtid.ui.look import Look
from rtid.ui.map_view import MapView
from rtid.ui.session import Session
from rtid.ui.time_plots import TimePlots, spans_of
from rtid.ui.where_view import WhereView

Put = Callable[[dict[str, str]], None]


class DeskViews:
    """Compare, Where, Why, Add and Map of one page."""

    def __init__(self, session: Session, roots: dict[str, Column], put: Put) -> None:
        self.session, self._roots, self._put = session, roots, put
        self._time = TimePlots(spans_of(self._look), self._mark_span)
        self._compare: CompareView | None = None
        self._where: WhereView | None = None
        self._add: AddView | None = None
        self._map: MapView | None = None
        self._page = ""

    @property
    def _look(self) -> Look:
        return self.session.revisions[-1].look

    def show(self, view: str) -> None:
        """Look at a view."""
        self._make(view)
        self._time.look_at(view)
        self._tell()

    def _make(self, view: str) -> None:
        """Make a view that nobody has looked at before."""
        if view == "compare" and self._compare is None:
            self._compare = CompareView(self._look, self._time)
            self._place("compare", self._compare.root)
        elif view == "where" and self._where is None:
            self._where = WhereView(self._look, self._time, self._mark_block)
            self._show_revision(len(self.session.revisions) - 1)
            self._place("where_maps", self._where.maps)
            self._place("where_time", self._where.side)
        elif view == "add" and self._add is None:
            self._add = AddView(self._look, self._time)
            self._add.show(self.session.revisions)
            self._place("add", self._add.root)
        elif view == "map" and self._map is None:
            opened = self.session.opened
            self._map = MapView(self._look.flowmap, opened.reference if opened else None)
            self._map.show()
            self._place("map", self._map.root)

    def prepare(self) -> bool:
        """Make one more view before it is looked at; False where all are made."""
        made = {"where": self._where, "add": self._add, "map": self._map, "compare": self._compare}
        missing = [name for name, view in made.items() if view is None]
        if missing:
            self._make(missing[0])
        return len(missing) > 1

    def refresh(self, what: str) -> None:
        """Show what has changed in the session."""
        if what == "looks":
            if self._compare:
                self._compare.show(self._look)
            self._forget()
            self._show_revision(len(self.session.revisions) - 1)
            if self._add:
                self._add.show(self.session.revisions)
            if self._map:
                self._map.show(self._look.flowmap)
        self._tell()

    def take(self, what: str, asked: dict[str, str]) -> None:
        """Do what a user asks of the pictures."""
        name = asked.get("name", "")
        if what in ("run", "next_run") and self._compare:
            runs = self._compare.run
            following = RUNS[(RUNS.index(runs) + 1) % len(RUNS)]
            self._compare.show(self._look, name if what == "run" else following)
        elif what in ("quantity", "part", "signal") and self._where:
            self._where.choose(what, name)
        elif what in ("edge", "beside", "along", "second") and self._map:
            self._map.choose(what, name)
        elif what == "revision" and self._where and name in self._where.revisions:
            self._show_revision(self._where.revisions.index(name))
        elif what == "page":
            self._page = name
        elif what == "worst" and self._where and self._where.worst:
            worst = self._where.worst
            self._mark_block((worst.edge, worst.i, worst.j))
        elif what == "forget":
            self._forget()
        elif what == "drag":
            self._time.set_drag(asked.get("mode", ""))
        self._tell()

    def _show_revision(self, number: int) -> None:
        """Where the model fails, of one of the revisions."""
        if self._where is None:
            return
        revisions = self.session.revisions
        names = [f"{k} {add_view.name_of(r, k)}" for k, r in enumerate(revisions)]
        self._where.revisions = names if len(names) > 1 else []
        self._where.revision = names[number]
        self._where.show(revisions[number].look)

    def _tell(self) -> None:
        """The words of all views."""
        session = self.session
        told = session.last.told if session.last else None
        parts = why_view.fragments(told, self._page, may_add=True)
        parts |= {"add_bars": add_view.bars(session), "add_says": add_view.sentence(session)}
        for view in (self._compare, self._where, self._map):
            parts |= view.fragments() if view else {}
        self._put(parts)

    def _place(self, root: str, made: UIElement) -> None:
        self._roots[root].children = [made]

    def _mark_block(self, key: Key) -> None:
        """A block was pointed at: its time spans light up."""
        edge, i, j = key
        spans = []
        try:
            for part in self._look.parts.values():
                spans += spans_of_block(self._look.model, part.equation, edge, i, j)
        except NoSuchBlockError:
            return
        self._time.light(spans)
        total = sum(b - a for a, b in spans)
        grid = next(e.grid for e in self._look.model.edges if e.name == edge)
        where = f"{edge}, {grid.u_v[i]:g} to {grid.u_v[i + 1]:g} V, " + (
            f"{grid.dp_pa[j] / 1e6:.3g} to {grid.dp_pa[j + 1] / 1e6:.3g} MPa"
        )
        if self._where:
            words = (
                f"Block <b>{text(where)}</b>: the valve was there {len(spans)} times, "
                f"{total:.1f} s in all; these spans are marked in every plot over time."
            )
            self._where.mark(key, words)
        self._tell()

    def _mark_span(self, low: float, high: float) -> None:
        """A time span was selected: its blocks are outlined."""
        self._time.light([(low, high)])
        found: dict[Key, float] = {}
        for part in self._look.parts.values():
            for visit in blocks_in_span(self._look.model, part.equation, low, high):
                key = visit.edge, visit.i, visit.j
                found[key] = found.get(key, 0.0) + visit.time_s
        if self._where:
            self._where.mark(None, f"From <b>{low:.2f} to {high:.2f} s</b> the valves were in "
                             f"{len(found)} blocks, which are outlined.")  # fmt: skip
            self._where.planes.light(list(found))
        self._tell()

    def _forget(self) -> None:
        self._time.light([])
        if self._where:
            self._where.mark(None, "")
