"""Where: in which part of which valve's map the model fails, when that was, and what it follows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import UIElement
from bokeh.plotting import figure

from rtid.colours import CHAMBERS
from rtid.compare import BlockRow, Dependence
from rtid.compare.tables import CAUSES, cause_of
from rtid.report_words import text
from rtid.ui.blocks import HATCHES, LARGEST, ML_PER_MIN, BlockPlots, Key, quantities, round_up
from rtid.ui.compare_view import NAMES, flows_of
from rtid.ui.dependence_plot import DependencePlot
from rtid.ui.fragments import button, choice, select
from rtid.ui.lines import Lines
from rtid.ui.look import Look
from rtid.ui.time_plots import TimePlots
from rtid.units import MPA


class WhereView:
    """Planes of all valves on the left; residual over time and over a signal on the right."""

    def __init__(self, look: Look, plots: TimePlots, on_block: Callable[[Key], None]) -> None:
        self.look = look
        self.part = "validation" if "validation" in look.parts else next(iter(look.parts))
        self.quantity = "residual"
        self._time = plots
        every = [b for part in look.parts.values() for b in part.blocks]
        values = [b.residual_rms_m3s * ML_PER_MIN for b in every if np.isfinite(b.residual_rms_m3s)]
        top = round_up(float(np.quantile(values, LARGEST))) if values else 1.0
        self._quantities = quantities(top)
        self.planes = BlockPlots(look.model, every, on_block)
        self._over = DependencePlot([chamber.name for chamber in look.model.chambers])
        self.signal = self._depends[0].signal if self._depends else ""
        self._lines = Lines()
        self.side = self._side()
        self.chosen: Key | None = None
        self.words = ""
        self.revisions: list[str] = []  # names, where there are several to choose from
        self.revision = ""

    @property
    def maps(self) -> UIElement:
        """The planes."""
        return self.planes.root

    @property
    def _depends(self) -> list[Dependence]:
        return self.look.parts[self.part].depends

    @property
    def blocks(self) -> list[BlockRow]:
        """Of the part that is shown."""
        return self.look.parts[self.part].blocks

    def _side(self) -> UIElement:
        chambers = self.look.model.chambers
        strips: list[figure] = []
        for c, chamber in enumerate(chambers):
            title, is_last = f"residual of chamber {chamber.name} over time", c == len(chambers) - 1
            strip = self._time.plot("where", "L/min", title, is_last)
            self._lines.add(strip, f"left {c}", CHAMBERS[c], 0.8)
            strips.append(strip)
        parts = [row(s, sizing_mode="stretch_both") for s in (*strips, self._over.root)]
        return column(*parts, sizing_mode="stretch_both")

    def show(self, look: Look | None = None) -> None:
        """Draw what is chosen, of another revision if one is given."""
        self.look = look or self.look
        parts = [p.equation for p in self.look.parts.values()]
        self._lines.show(flows_of(e.t_s, e.measured_m3s, e.residual_m3s) for e in parts)
        self.planes.show(self.blocks, self._quantities[self.quantity])
        self._show_signal()

    def choose(self, what: str, name: str) -> None:
        """Another quantity, part or signal."""
        if what == "quantity" and name in self._quantities:
            self.quantity = name
        elif what == "part" and name in self.look.parts:
            self.part = name
        elif what == "signal" and name in [d.signal for d in self._depends]:
            self.signal = name
        self.planes.show(self.blocks, self._quantities[self.quantity])
        self._show_signal()

    def mark(self, key: Key | None, words: str) -> None:
        """A block that was pointed at, and what to say of it."""
        self.chosen, self.words = key, words
        self.planes.light([key] if key else [])

    @property
    def worst(self) -> BlockRow | None:
        """The block with the largest share of the residual."""
        return max(self.blocks, key=lambda b: b.residual_share, default=None)

    def _show_signal(self) -> None:
        found = next((d for d in self._depends if d.signal == self.signal), None)
        if found is not None:
            self._over.show(found)

    def fragments(self) -> dict[str, str]:
        """Tools above, and what the picture says."""
        parts = {name: NAMES.get(name, name) for name in self.look.parts}
        signals = [d.signal for d in self._depends]
        tools = select("revision", self.revisions, self.revision, "model") if self.revisions else ""
        tools += (
            select("quantity", list(self._quantities), self.quantity, "blocks show")
            + self._scale()
            + select("part", parts, self.part, "of")
            + select("signal", signals, self.signal, "residual over")
            + "<span><label>drag </label>"
            + choice("drag", ["zoom", "span"], self._time.drag, "mode")
            + "</span>"
            + button("largest error", "worst")
            + button("forget marks", "forget")
        )
        return {"where_tools": tools, "where_says": self._sentence()}

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
            f"The block <b>{text(worst.edge)}, {worst.u_v[0]:g} to {worst.u_v[1]:g} V, "
            f"{worst.dp_pa[0] * MPA:.3g} to {worst.dp_pa[1] * MPA:.3g} MPa</b> holds "
            f"{100 * worst.residual_share:.0f} % of the residual of its chambers. Click a block: "
            "its time spans light up here and in Compare; drag a span: its blocks are outlined. "
            f"A map that fails everywhere alike lacks an effect, not data: see <b>Why</b>.{hatched}"
        )
