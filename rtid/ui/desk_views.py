"""The views of a record: made when they are first looked at, and what a user does in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from bokeh.models import Column

from rtid.compare import NoSuchBlockError
from rtid.compare.places import blocks_in_span, spans_of_block
from rtid.study.look import Look
from rtid.tell.axes import place
from rtid.tell.charts.blocks import Key
from rtid.tell.charts.time_plots import TimePlots, spans_of
from rtid.tell.html import text
from rtid.ui.shared import Session
from rtid.ui.views import Action, PageView, ViewRow, made

Put = Callable[[dict[str, str]], None]


class Bench:
    """What a page gives its views: the session, and plots over time that are zoomed together."""

    def __init__(
        self, session: Session, mark_block: Callable[[Key], None], mark_span: Callable[..., None]
    ) -> None:
        self.session, self.mark_block = session, mark_block
        self.time = TimePlots(spans_of(self.look), mark_span)

    @property
    def look(self) -> Look:
        """The newest revision of the model, held against the record."""
        return self.session.seen[-1].look


class DeskViews:
    """The views of one page that need a record."""

    def __init__(
        self, session: Session, rows: Mapping[str, ViewRow], roots: dict[str, Column], put: Put
    ) -> None:
        self._rows = {name: row for name, row in rows.items() if row.where}
        self._roots, self._put = roots, put
        self._bench = Bench(session, self._mark_block, self._mark_span)
        self._views: dict[str, PageView] = {}
        self._stale: set[str] = set()  # views that show what was before
        self._looked_at = ""

    def show(self, view: str) -> None:
        """Look at a view."""
        self._looked_at = view
        self._make(view)
        self._bench.time.look_at(view)
        self._tell()

    def _make(self, name: str) -> None:
        """Make a view that nobody has looked at before, or have it show what is now."""
        if name in self._stale:
            self._stale.remove(name)
            self._views[name].refresh()
        if name in self._views or name not in self._rows:
            return
        self._views[name] = view = made(self._rows[name], self._bench)
        view.refresh()
        for word, root in view.roots.items():
            self._roots[f"{name}_{word}"].children = [root]

    def prepare(self) -> bool:
        """Make one more view before it is looked at; False where all are made."""
        missing = [name for name in self._rows if name not in self._views or name in self._stale]
        if missing:
            self._make(missing[0])
        return len(missing) > 1

    def refresh(self, what: str) -> None:
        """Show what has changed in the session, in the view that is looked at first."""
        if what == "looks":
            self._forget()
        if what in ("looks", "told"):
            self._stale = set(self._views)
            self._make(self._looked_at)
        self._tell()

    def take(self, what: str, asked: dict[str, str]) -> None:
        """Do what a user asks of the pictures."""
        its_own: dict[str, Action] = {
            "forget": lambda _: self._forget(),
            "drag": lambda asked: self._bench.time.set_drag(asked.get("mode", "")),
            "zoom": self._zoom,
        }
        looked_at = [view for name, view in self._views.items() if name == self._looked_at]
        every = [its_own, *(view.actions for view in (*looked_at, *self._views.values()))]
        action = next((actions[what] for actions in every if what in actions), None)
        if action is not None:
            action(asked)
        self._tell()

    def _zoom(self, asked: dict[str, str]) -> None:
        """A page has come to a window of time that it has too few values of."""
        try:
            low, high = float(asked["low"]), float(asked["high"])
        except (KeyError, ValueError):
            return
        self._bench.time.zoom(asked.get("view", ""), low, high)

    def _tell(self) -> None:
        """The words of all views."""
        parts: dict[str, str] = {}
        for name, view in self._views.items():
            parts |= {f"{name}_{word}": html for word, html in view.fragments().items()}
        self._put(parts)

    def _mark(self, keys: list[Key], words: str) -> None:
        for view in self._views.values():
            view.mark(keys, words)

    def _mark_block(self, key: Key) -> None:
        """A block was pointed at: its time spans light up."""
        edge, i, j = key
        look, spans = self._bench.look, []
        try:
            for part in look.parts.values():
                spans += spans_of_block(look.model, part.equation, edge, i, j)
        except NoSuchBlockError:
            return
        self._bench.time.light(spans)
        total = sum(b - a for a, b in spans)
        of = next(e for e in look.model.edges if e.name == edge)
        u, dp = of.grid.u_v[[i, i + 1]].tolist(), of.grid.dp_pa[[j, j + 1]].tolist()
        where = f"{edge}, {place(look.model.axes(of), u, dp)}"
        words = (
            f"Block <b>{text(where)}</b>: the valve was there {len(spans)} times, {total:.1f} s in "
            "all; these spans are marked in every plot over time."
        )
        self._mark([key], words)
        self._tell()

    def _mark_span(self, low: float, high: float) -> None:
        """A time span was selected: its blocks are outlined."""
        self._bench.time.light([(low, high)])
        look = self._bench.look
        keys = dict.fromkeys(
            (visit.edge, visit.i, visit.j)
            for part in look.parts.values()
            for visit in blocks_in_span(look.model, part.equation, low, high)
        )
        self._mark(list(keys), f"From <b>{low:.2f} to {high:.2f} s</b> the valves were in "
                   f"{len(keys)} blocks, which are outlined.")  # fmt: skip
        self._tell()

    def _forget(self) -> None:
        self._bench.time.light([])
        self._mark([], "")
