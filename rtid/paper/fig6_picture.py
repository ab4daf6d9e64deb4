"""Fig. 6 drawn: the motion, and the tracking error with each of the three maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from rtid.colours import BLUE, GREEN, INK, ORANGE
from rtid.pictures.style import STYLE
from rtid.sim.motion import DT_S
from rtid.sim.plant import FloatArray
from rtid.sim.robust import Tracked

CALIBRATED, ESTIMATED, MANUFACTURER = "calibrated", "estimated", "manufacturer's"
FIRST_SWEEP = "estimated, first sweep"
KINDS = CALIBRATED, ESTIMATED, FIRST_SWEEP, MANUFACTURER
SHOWN = CALIBRATED, ESTIMATED, MANUFACTURER
COLOURS = {CALIBRATED: GREEN, ESTIMATED: BLUE, MANUFACTURER: ORANGE}
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


def draw(found: Compared) -> Figure:
    """Reference on top, the errors below, once more without the largest."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 6.6))
        first, second, third = figure.subplots(3, 1, sharex=True)
        t = DT_S * np.arange(len(found.reference))
        first.plot(t, 1e3 * found.reference[:, 0], color=INK)
        first.set(ylabel="reference in mm", title=f"random boom {found.number}")
        for axis, kinds in ((second, SHOWN), (third, SHOWN[:2])):
            for kind in reversed(kinds):
                error_mm = 1e3 * found.runs[kind][0].error_m
                axis.plot(t, error_mm, color=COLOURS[kind], lw=1.0, label=kind)
            axis.set_ylabel("error in mm")
            axis.legend(loc="upper right", ncols=3)
        second.set_title("tracking error")
        third.set_title("the same without the manufacturer's map")
        third.set_xlabel("time in s")
    return figure
