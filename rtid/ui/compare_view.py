"""Compare: measured and modelled pressures and flows of every chamber, what is left below."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import Title, UIElement
from bokeh.plotting import figure

from rtid.compare import FREE_RUN, HORIZONS_S, Comparison
from rtid.study.look import RecordShare
from rtid.tell.charts.flows import NAMES, flow_plots, flows_of, pressures_of
from rtid.tell.charts.theme import INK_TAG, beside
from rtid.tell.colours import BLUE, ORANGE
from rtid.tell.html import button, choice, text
from rtid.ui.desk_views import Bench
from rtid.ui.views import PageView

RUNS = list(HORIZONS_S)


class CompareView(PageView):
    """The first page: whether the model explains the record."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        look, self.run = bench.look, FREE_RUN
        self._time = bench.time
        self._pressures, self._flows = (self._time.lines("compare") for _ in range(2))
        self._titles: list[Title] = []
        self.has_runs = any(part.runs for part in look.parts.values())
        columns = [self._column(c, chamber.name) for c, chamber in enumerate(look.model.chambers)]
        self.roots = {"plot": beside(*columns)}
        self.actions = {
            "run": lambda asked: self._show(asked.get("name", "")),
            "next_run": lambda _: self._show(RUNS[(RUNS.index(self.run) + 1) % len(RUNS)]),
        }

    def refresh(self) -> None:
        """Another revision."""
        self._show(self.run)

    def _column(self, c: int, name: str) -> UIElement:
        """Pressure, its difference, flow and its difference of one chamber."""
        made: list[figure] = []
        if self.has_runs:
            made = [self._time.plot("compare", unit, " ", False) for unit in ("MPa", "kPa")]
            self._pressures.add(made[0], f"measured {c}", INK_TAG, 1.4)
            self._pressures.add(made[0], f"model {c}", ORANGE, 1.0)
            self._pressures.add(made[1], f"left {c}", BLUE, 0.8)
            made[1].title.visible = False
        made += flow_plots(self._time, "compare", self._flows, c, f"chamber {name}: flow")
        self._titles.append(made[0].title)
        weights = ("1.5", "1", "1.5", "1.15")[-len(made) :]
        parts = [
            row(p, sizing_mode="stretch_both", styles={"flex": weight})
            for p, weight in zip(made, weights, strict=True)
        ]
        return column(*parts, sizing_mode="stretch_both")

    def _show(self, run: str) -> None:
        self.run = run if run in RUNS else self.run
        parts = list(self.look.parts.values())
        if self.has_runs:
            self._pressures.show(pressures_of(part.runs[self.run]) for part in parts if part.runs)
        self._flows.show(flows_of(part.equation) for part in parts)
        for c, title in enumerate(self._titles):
            title.text = self._title(c)

    def _title(self, c: int) -> str:
        name = self.look.model.chambers[c].name
        if not self.has_runs:
            return f"chamber {name}: flow"
        fits = ", ".join(
            f"{_fit(part.fits[self.run][c])} {NAMES.get(title, title)}"
            for title, part in self.look.parts.items()
            if part.runs
        )
        return f"chamber {name}: pressure, {self.run} - fit {fits}"

    def fragments(self) -> Mapping[str, str]:
        """Tools above and the sentence below."""
        tools = choice("run", RUNS, self.run) if self.has_runs else ""
        tools += (
            f"<span><label>drag </label>{choice('drag', ['zoom', 'span'], self._time.drag, 'mode')}"
            f"</span>{button('whole record', 'whole')}"
            '<span class="key"><b style="color:var(--ink)">—</b> measured '
            '<b style="color:var(--before)">—</b> model '
            '<b style="color:var(--bar)">—</b> difference &nbsp; '
            "blue ground: taught the model, yellow: held out</span>"
        )
        return {"tools": tools, "says": self._sentence()}

    def _sentence(self) -> str:
        rest = " and ".join(
            f"{_left(part.equation)} ({NAMES.get(title, title)})"
            for title, part in self.look.parts.items()
            if len(part.equation.t_s)
        )
        words = (
            f"The learned map leaves <b>{rest}</b> of the flow unexplained (lower plots), blocks "
            "without data included, which the verdict leaves out. "
        )
        if self.look.records:
            words += f"Of each record: {', '.join(map(_of_record, self.look.records))}. "
        if self.has_runs and self.run == FREE_RUN:
            words += "Above, the model runs on its own pressures: what it gets wrong adds up. "
        elif self.has_runs:
            words += f"Above, the model starts from the measured pressures and runs {self.run}. "
        return words + "Next: <b>Where</b> shows in which part of which valve's map the rest is."


def _of_record(record: RecordShare) -> str:
    """What is left of one of several records, of its own flow."""
    held_out = " (held out)" if record.is_held_out else ""
    return f"{text(record.name)} {record.percent:.2g} %{held_out}"


def _fit(percent: float) -> str:
    """Of a free run that has left the record no decimals are told."""
    return f"{percent:.1f} %" if percent > -100 else "below -100 %"


def _left(part: Comparison) -> str:
    """Residual over flow of all chambers together."""
    flow = float(np.sqrt(np.mean(part.measured_m3s**2)))
    share = 100 * float(np.sqrt(np.mean(part.residual_m3s**2))) / flow if flow > 0 else np.nan
    return f"{share:.2g} %" if share < 99.5 else "all"
