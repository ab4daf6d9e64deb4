"""Compare: measured and modelled pressures and flows of every chamber, what is left below."""

from __future__ import annotations

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import Title, UIElement
from bokeh.plotting import figure

from rtid.colours import BLUE, ORANGE
from rtid.compare import FREE_RUN, HORIZONS_S, Comparison, Simulation
from rtid.model import FloatArray
from rtid.ui.fragments import button, choice
from rtid.ui.lines import Columns, Lines
from rtid.ui.look import Look
from rtid.ui.theme import INK_TAG
from rtid.ui.time_plots import TimePlots
from rtid.units import KPA, LPM, MPA

NAMES = {"identification": "identification", "validation": "held-out"}
RUNS = list(HORIZONS_S)


class CompareView:
    """The first page: whether the model explains the record."""

    def __init__(self, look: Look, plots: TimePlots) -> None:
        self.look, self.run = look, FREE_RUN
        self._time = plots
        self._pressures, self._flows = Lines(), Lines()
        self._titles: list[Title] = []
        self.has_runs = any(part.runs for part in look.parts.values())
        columns = [self._column(c, chamber.name) for c, chamber in enumerate(look.model.chambers)]
        self.root = row(*columns, sizing_mode="stretch_both")
        self.show(look)

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

    def show(self, look: Look, run: str | None = None) -> None:
        """Another revision, or another horizon of the simulation."""
        self.look, self.run = look, run if run in RUNS else self.run
        parts = list(look.parts.values())
        if self.has_runs:
            self._pressures.show(pressures_of(part.runs[self.run]) for part in parts if part.runs)
        self._flows.show(
            flows_of(p.equation.t_s, p.equation.measured_m3s, p.equation.residual_m3s)
            for p in parts
        )
        for c, title in enumerate(self._titles):
            title.text = self._title(c)

    def _title(self, c: int) -> str:
        name = self.look.model.chambers[c].name
        if not self.has_runs:
            return f"chamber {name}: flow"
        fits = ", ".join(
            f"{_fit(part.runs[self.run].fit_percent[c])} {NAMES.get(title, title)}"
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
            '<b style="color:var(--before)">—</b> model '
            '<b style="color:var(--bar)">—</b> difference &nbsp; '
            "blue ground: taught the model, yellow: held out</span>"
        )
        return {"compare_tools": tools, "compare_says": self._sentence()}

    def _sentence(self) -> str:
        left = " and ".join(
            f"{_left(part.equation)} ({NAMES.get(title, title)})"
            for title, part in self.look.parts.items()
            if len(part.equation.t_s)
        )
        text = (
            f"The learned map leaves <b>{left}</b> of the flow unexplained (lower plots), blocks "
            "without data included, which the verdict leaves out. "
        )
        if self.has_runs and self.run == FREE_RUN:
            text += "Above, the model runs on its own pressures: what it gets wrong adds up. "
        elif self.has_runs:
            text += f"Above, the model starts from the measured pressures and runs {self.run}. "
        return text + "Next: <b>Where</b> shows in which part of which valve's map the rest is."


def _fit(percent: float) -> str:
    """Of a free run that has left the record no decimals are told."""
    return f"{percent:.1f} %" if percent > -100 else "below -100 %"


def _left(part: Comparison) -> str:
    """Residual over flow of all chambers together."""
    flow = float(np.sqrt(np.mean(part.measured_m3s**2)))
    share = 100 * float(np.sqrt(np.mean(part.residual_m3s**2))) / flow if flow > 0 else np.nan
    return f"{share:.2g} %" if share < 99.5 else "all"


def flow_plots(
    time: TimePlots, view: str, lines: Lines, c: int, title: str, is_last: bool = True
) -> list[figure]:
    """Measured and modelled flow of a chamber, and what is left below."""
    made = [time.plot(view, "L/min", title, False), time.plot(view, "L/min", "", is_last)]
    lines.add(made[0], f"measured {c}", INK_TAG, 1.4)
    lines.add(made[0], f"model {c}", ORANGE, 1.0)
    lines.add(made[1], f"left {c}", BLUE, 0.8)
    return made


def flows_of(t_s: FloatArray, measured: FloatArray, left: FloatArray) -> tuple[FloatArray, Columns]:
    """Times (n,) and, per chamber, measured, modelled and what is left, from (n, chambers) m3/s."""
    columns = {"measured": measured, "model": measured - left, "left": left}
    return t_s, {f"{k} {c}": v[:, c] * LPM for k, v in columns.items() for c in range(v.shape[1])}


def pressures_of(run: Simulation) -> tuple[FloatArray, Columns]:
    """The same of simulated pressures; the difference in kPa."""
    model = np.where(run.predicted[:, None], run.simulated_pa, np.nan)
    columns = {
        "measured": run.measured_pa * MPA, "model": model * MPA, "left": run.error_pa * KPA
    }  # fmt: skip
    return run.t_s, {f"{k} {c}": v[:, c] for k, v in columns.items() for c in range(v.shape[1])}
