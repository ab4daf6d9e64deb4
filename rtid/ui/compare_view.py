"""Compare: measured and modelled pressures and flows of every chamber, what is left below."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import ColumnDataSource, Title, UIElement
from bokeh.plotting import figure

from rtid.colours import BLUE, KPA, LPM, MPA, ORANGE
from rtid.compare import FREE_RUN, HORIZONS_S
from rtid.ui.fragments import button, choice
from rtid.ui.lines import Line
from rtid.ui.look import Look
from rtid.ui.theme import INK_TAG, styled
from rtid.ui.time_plots import EMPTY, TimePlots

NAMES = {"identification": "identification", "validation": "held out"}
RUNS = list(HORIZONS_S)


class CompareView:
    """The first page: whether the model explains the record."""

    def __init__(self, look: Look, plots: TimePlots) -> None:
        self.look, self.run = look, FREE_RUN
        self._time = plots
        self._sources: list[dict[str, ColumnDataSource]] = []
        self._titles: list[Title] = []
        self.has_runs = any(part.runs for part in look.parts.values())
        self.root = row(*self._columns(), sizing_mode="stretch_both")

    def _columns(self) -> list[UIElement]:
        columns: list[Any] = []
        for chamber in self.look.model.chambers:
            made: dict[str, figure] = {}
            if self.has_runs:
                made["p"] = self._time.plot("MPa", " ")
                made["e"] = self._time.plot("kPa")
            made["q"] = self._time.plot("L/min", f"chamber {chamber.name}: flow")
            made["r"] = self._time.plot("L/min")
            sources = {}
            if self.has_runs:
                sources["pm"] = self._time.line(made["p"], EMPTY, INK_TAG, 1.4)
                sources["ps"] = self._time.line(made["p"], EMPTY, ORANGE, 1.0)
                sources["pe"] = self._time.line(made["e"], EMPTY, BLUE, 0.8)
            sources["qm"] = self._time.line(made["q"], EMPTY, INK_TAG, 1.4)
            sources["qs"] = self._time.line(made["q"], EMPTY, ORANGE, 1.0)
            sources["qr"] = self._time.line(made["r"], EMPTY, BLUE, 0.8)
            self._sources.append(sources)
            self._titles.append(styled(Title(text=" ")))
            made["p" if self.has_runs else "q"].title = self._titles[-1]
            list(made.values())[-1].xaxis.axis_label = "time in s"
            for p in list(made.values())[:-1]:
                p.xaxis.major_label_text_font_size = "0px"
                p.min_border_bottom = 0
            parts = [
                row(p, sizing_mode="stretch_both", styles={"flex": weight})
                for p, weight in zip(made.values(), ("1.5", "1", "1.5", "1.15"), strict=False)
            ]
            columns.append(column(*parts, sizing_mode="stretch_both"))
        return columns

    def show(self, look: Look, run: str | None = None) -> None:
        """Another revision, or another horizon of the simulation."""
        self.look, self.run = look, run if run in RUNS else self.run
        parts = list(look.parts.values())
        for c, sources in enumerate(self._sources):
            if self.has_runs:
                runs = [part.runs[self.run] for part in parts if part.runs]
                lines = {
                    "pm": [(r.t_s, r.measured_pa[:, c] * MPA) for r in runs],
                    "ps": [(r.t_s, _where(r.predicted, r.simulated_pa[:, c] * MPA)) for r in runs],
                    "pe": [(r.t_s, r.error_pa[:, c] * KPA) for r in runs],
                }
            else:
                lines = {}
            rows = [part.equation for part in parts]
            lines["qm"] = [(e.t_s, e.measured_m3s[:, c] * LPM) for e in rows]
            lines["qs"] = [(e.t_s, e.modelled_m3s[:, c] * LPM) for e in rows]
            lines["qr"] = [(e.t_s, e.residual_m3s[:, c] * LPM) for e in rows]
            for name, pieces in lines.items():
                self._time.change(sources[name], Line.joined(pieces))
            self._titles[c].text = self._title(c)
        self._time.refresh()

    def _title(self, c: int) -> str:
        name = self.look.model.chambers[c].name
        if not self.has_runs:
            return f"chamber {name}: flow"
        fits = ", ".join(
            f"{part.runs[self.run].fit_percent[c]:.1f} % {NAMES.get(title, title)}"
            for title, part in self.look.parts.items()
            if part.runs
        )
        return f"chamber {name}: pressure, {self.run} - fit {fits}"

    def fragments(self) -> dict[str, str]:
        """Tools above and the sentence below."""
        tools = choice("run", RUNS, self.run) if self.has_runs else ""
        tools += (
            f"<span><label>drag </label>{choice('drag', ['zoom', 'span'], self._time.drag, 'mode')}"
            f"</span>{button('whole record', 'whole')}"
            '<span class="key"><b style="color:var(--ink)">—</b> measured '
            f'<b style="color:{ORANGE}">—</b> model <b style="color:{BLUE}">—</b> difference '
            "&nbsp; blue ground: taught the model, yellow: held out</span>"
        )
        return {"compare_tools": tools, "compare_says": self._sentence()}

    def _sentence(self) -> str:
        shares = {
            NAMES.get(t, t): 100 * float(np.sqrt(np.mean(p.equation.residual_share**2)))
            for t, p in self.look.parts.items()
            if len(p.equation.t_s)
        }
        left = " and ".join(f"{v:.2g} % ({n})" for n, v in shares.items())
        text = (
            f"The learned map leaves <b>{left}</b> of the flow unexplained (lower plots). In the "
            "upper plots the model runs on its own pressures: what it gets wrong adds up. "
        )
        return text + "Next: <b>Where</b> shows in which part of which valve's map it fails."


def _where(known: Any, values: Any) -> Any:
    return np.where(known, values, np.nan)
