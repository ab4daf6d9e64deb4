"""Where: in which part of which valve's map the model fails, when that was, and what it follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from bokeh.layouts import column, row
from bokeh.models import Row, UIElement
from bokeh.plotting import figure

from rtid.compare import BlockRow, Dependence
from rtid.compare.tables import CAUSES, cause_of
from rtid.study.look import Look
from rtid.tell.axes import axes_of, place
from rtid.tell.charts.blocks import HATCHES, BlockPlots, Key, quantities_of
from rtid.tell.charts.dependence import over_signal
from rtid.tell.charts.flows import NAMES, flows_of
from rtid.tell.colours import CHAMBERS
from rtid.tell.html import button, choice, select, text
from rtid.tell.live import PanelPlot
from rtid.tell.story import Panel
from rtid.tell.words import named
from rtid.ui.add_view import name_of
from rtid.ui.desk_views import Bench
from rtid.ui.shared import ShownRevision
from rtid.ui.views import PageView
from rtid.units import flow_name

CHOICES = ("quantity", "part", "signal", "revision")


class WhereView(PageView):
    """Planes of all valves on the left; residual over time and over a signal on the right."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        self._shown, look = bench.session.seen[-1], bench.look
        self.part = "validation" if "validation" in look.parts else next(iter(look.parts))
        self.quantity = "residual"
        self._time = bench.time
        every = [b for part in look.parts.values() for b in part.blocks]
        self._quantities = quantities_of(every)
        self.planes = BlockPlots(look.model, every, bench.mark_block)
        self._asked = ""  # the signal that the user wants to see
        self._over = Row(sizing_mode="stretch_both")
        self._drawn: tuple[Look, str, str] | None = None
        self._lines = self._time.lines("where")
        self.side = self._side()
        self.words = ""
        self.roots = {"maps": self.planes.root, "time": self.side}
        choices = {what: partial(self.choose, what) for what in CHOICES}
        self.actions = choices | {"worst": lambda _: self._to_worst()}
        self.revisions: list[str] = []  # names, where there are several to choose from
        self.revision = ""

    @property
    def look(self) -> Look:
        """The revision that is shown."""
        return self._shown.look

    def refresh(self) -> None:
        """The newest revision, and the names of all."""
        revisions = self.bench.session.seen
        names = [f"{k} {name_of(r, k)}" for k, r in enumerate(revisions)]
        self.revisions = names if len(names) > 1 else []
        self.revision, self._shown = names[-1], revisions[-1]
        self.show()

    @property
    def _pictures(self) -> dict[str, Panel]:
        """The residual over what a named effect is proportional to, then over every signal."""
        names = [chamber.name for chamber in self.look.model.chambers]
        depends = sorted(self.look.parts[self.part].depends, key=_explained, reverse=True)
        return _evidence(self._shown) | {d.signal: over_signal(names, d) for d in depends}

    @property
    def signal(self) -> str:
        """What the residual is shown over: as chosen, else what explains most."""
        pictures = self._pictures
        return self._asked if self._asked in pictures else next(iter(pictures), "")

    @property
    def blocks(self) -> list[BlockRow]:
        """Of the part that is shown."""
        return self.look.parts[self.part].blocks

    def _side(self) -> UIElement:
        chambers = self.look.model.chambers
        strips: list[figure] = []
        for c, chamber in enumerate(chambers):
            title, is_last = f"residual of chamber {chamber.name} over time", c == len(chambers) - 1
            strip = self._time.plot("where", flow_name(), title, is_last)
            self._lines.add(strip, f"left {c}", CHAMBERS[c], 0.8)
            strips.append(strip)
        parts = [row(s, sizing_mode="stretch_both") for s in (*strips, self._over)]
        return column(*parts, sizing_mode="stretch_both")

    def show(self) -> None:
        """Draw what is chosen."""
        self._lines.show(flows_of(part.equation) for part in self.look.parts.values())
        self.planes.show(self.blocks, self._quantities[self.quantity])
        if (wanted := (self.look, self.part, self.signal)) != self._drawn:
            panel = self._pictures.get(self.signal)
            self._over.children = [PanelPlot(panel).root] if panel else []
            self._drawn = wanted

    def choose(self, what: str, asked: dict[str, str]) -> None:
        """Another quantity, part, signal or revision."""
        name = asked.get("name", "")
        if what == "quantity" and name in self._quantities:
            self.quantity = name
        elif what == "part" and name in self.look.parts:
            self.part = name
        elif what == "signal":
            self._asked = name
        elif what == "revision" and name in self.revisions:
            self.revision = name
            self._shown = self.bench.session.seen[self.revisions.index(name)]
        self.show()

    def mark(self, keys: Sequence[Key], words: str) -> None:
        """Blocks that were pointed at, and what to say of them."""
        self.words = words
        self.planes.light(keys)

    def _to_worst(self) -> None:
        if (worst := self.worst) is not None:
            self.bench.mark_block((worst.edge, worst.i, worst.j))

    @property
    def worst(self) -> BlockRow | None:
        """The block with the largest share of the residual."""
        return max(self.blocks, key=lambda b: b.residual_share, default=None)

    def fragments(self) -> Mapping[str, str]:
        """Tools above, and what the picture says."""
        parts = {name: NAMES.get(name, name) for name in self.look.parts}
        tools = select("revision", self.revisions, self.revision, "model") if self.revisions else ""
        tools += (
            select("quantity", list(self._quantities), self.quantity, "blocks show")
            + self._scale()
            + select("part", parts, self.part, "of")
            + select("signal", list(self._pictures), self.signal, "residual over")
            + "<span><label>drag </label>"
            + choice("drag", ["zoom", "span"], self._time.drag, "mode")
            + "</span>"
            + button("largest error", "worst")
            + button("forget marks", "forget")
        )
        return {"tools": tools, "says": self._sentence()}

    def _place(self, block: BlockRow) -> str:
        return place(axes_of(self.look.model)[block.edge], block.u_v, block.dp_pa)

    def _scale(self) -> str:
        q = self._quantities[self.quantity]
        if q.name == "status":
            return ""
        stops = ", ".join(q.palette[:: max(1, len(q.palette) // 8)])
        kind = ", decades" if q.is_log else ""
        return (
            f'<span class="key">{q.low:g}<i class="scale" style="background:'
            f'linear-gradient(90deg, {stops})"></i>{q.high:g} {text(q.unit)}{kind}</span>'
        )

    def _sentence(self) -> str:
        present = dict.fromkeys(cause_of(b) for b in self.blocks)
        marks = {" ": "", ".": "dots", "/": "/ hatching", "\\": "\\ hatching", "x": "x hatching"}
        reasons = ", ".join(
            f"{marks.get(HATCHES[c], HATCHES[c])} {c}" for c in CAUSES[1:] if c in present
        )
        hatched = f" Not identified: {text(reasons)}." if reasons else ""
        if self.words:
            return f"{self.words}{hatched}"
        worst = self.worst
        if worst is None:
            return (
                "No valve was open in this part of the record, so no block can be judged. Next: "
                "choose the other part above, or record a motion that opens the valves."
            )
        return (
            f"The block <b>{text(worst.edge)}, {text(self._place(worst))}</b> holds "
            f"{100 * worst.residual_share:.0f} % of the residual of its chambers. Click a block: "
            "its time spans light up here and in Compare; drag a span: its blocks are outlined. "
            f"A map that fails everywhere alike lacks an effect, not data: see <b>Why</b>.{hatched}"
        )


def _explained(depends: Dependence) -> float:
    """Share of the residual's variance, in all chambers."""
    return float(depends.explained.sum())


def _evidence(shown: ShownRevision) -> dict[str, Panel]:
    """What the verdict rests on, by the name of the effect; nothing where none is named.

    The maps have learned a part of what is missing, so that the plain residual may follow nothing.
    """
    ranked = shown.told
    if ranked is None:
        return {}
    pairs = zip(ranked.diagnosis.found, ranked.evidence, strict=False)
    return {named((effect.effect, effect.where)): chart.panels[0][0] for effect, chart in pairs}
