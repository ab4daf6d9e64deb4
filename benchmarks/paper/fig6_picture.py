"""Fig. 6 drawn: the motion, and the tracking error with each of the three maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtid.plain import FloatArray
from rtid.sim.demand import DT_S
from rtid.sim.robust import Tracked
from rtid.tell.colours import BLUE, GREEN, GREY, INK, ORANGE
from rtid.tell.stills import STYLE

CALIBRATED, ESTIMATED, MANUFACTURER = "calibrated", "estimated", "manufacturer's"
FIRST_SWEEP = "estimated, first sweep"
KINDS = CALIBRATED, ESTIMATED, FIRST_SWEEP, MANUFACTURER
SHOWN = CALIBRATED, ESTIMATED, MANUFACTURER
COLOURS = {CALIBRATED: GREEN, ESTIMATED: BLUE, MANUFACTURER: ORANGE}
VALVES = {  # colours of their commands
    "supply to A": BLUE,
    "A to tank": GREEN,
    "supply to B": ORANGE,
    "B to tank": GREY,
    "A to B": INK,
}
BESIDE_TITLE: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.97), "borderpad": 0}
SURE = 2.0  # standard errors of a paired difference


def rms_m(runs: Sequence[Tracked]) -> float:
    """Root mean square of the tracking error over several runs."""
    return float(np.sqrt(np.mean([run.rms_m**2 for run in runs])))


@dataclass(frozen=True)
class Compared:
    """One machine: its number, the reference (n, 4), and repeated runs with each map."""

    number: int
    reference: FloatArray
    runs: dict[str, tuple[Tracked, ...]]

    def rms_m(self, kind: str) -> float:
        """Root mean square of the tracking error over all repetitions."""
        return rms_m(self.runs[kind])

    def energy_j(self, kind: str) -> float:
        """From the supply, mean over the repetitions."""
        return float(np.mean([run.energy_j for run in self.runs[kind]]))

    @property
    def ratio(self) -> float:
        """Tracking error with the estimated over that with the calibrated map."""
        return self.rms_m(ESTIMATED) / self.rms_m(CALIBRATED)

    @property
    def in_order_but_for_noise(self) -> bool:
        """Calibrated first, or not behind estimated by more than the repetitions scatter."""
        squares = {k: np.array([run.rms_m**2 for run in self.runs[k]]) for k in SHOWN}
        lead = squares[CALIBRATED] - squares[ESTIMATED]
        sd = float(np.std(lead, ddof=1) / np.sqrt(len(lead)))
        beaten = self.rms_m(ESTIMATED) < self.rms_m(MANUFACTURER)
        return bool(lead.mean() <= SURE * sd and beaten)


def draw(compared: Compared) -> Figure:
    """Reference on top, the errors below, once more without the largest, then the five valves."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 8.6))
        first, second, third, last = figure.subplots(4, 1, sharex=True)
        t = DT_S * np.arange(len(compared.reference), dtype=np.float64)
        first.plot(t, 1e3 * compared.reference[:, 0], color=INK)
        first.set(ylabel="reference in mm", title=f"random boom {compared.number}")
        for axis, kinds in ((second, SHOWN), (third, SHOWN[:2])):
            for kind in reversed(kinds):
                error_mm = 1e3 * compared.runs[kind][0].error_m
                axis.plot(t, error_mm, color=COLOURS[kind], lw=1.0, label=kind)
            axis.set_ylabel("error in mm")
            axis.legend(**BESIDE_TITLE, ncols=3)
        second.set_title("tracking error")
        third.set_title("the same without the manufacturer's map")
        _draw_valves(last, t, compared.runs[ESTIMATED][0].commands_v)
    return figure


def _draw_valves(axis: Axes, t: FloatArray, commands_v: FloatArray) -> None:
    """The commands with the estimated map; a valve that is shut is not drawn."""
    for i, (edge, colour) in enumerate(VALVES.items()):
        w = np.where(commands_v[:, i] > 0, commands_v[:, i], np.nan)
        axis.plot(t, w, ".", color=colour, ms=1.5, label=edge)
    axis.set(ylabel="command in V", xlabel="time in s", title="valves, with the estimated map")
    axis.legend(**BESIDE_TITLE, ncols=5, markerscale=5)
