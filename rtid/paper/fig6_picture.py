"""Fig. 6 drawn: the motion, and the tracking error with each of the three maps."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from rtid.colours import BLUE, GREEN, INK, ORANGE
from rtid.pictures.style import STYLE
from rtid.sim.motion import DT_S
from rtid.sim.plant import FloatArray
from rtid.sim.robust import Tracked

CALIBRATED, ESTIMATED, MANUFACTURER = KINDS = ("calibrated", "estimated", "manufacturer's")
COLOURS = {CALIBRATED: GREEN, ESTIMATED: BLUE, MANUFACTURER: ORANGE}


@dataclass(frozen=True)
class Compared:
    """One machine: its number, the reference (n, 4), and a run with each map."""

    number: int
    reference: FloatArray
    runs: dict[str, Tracked]

    @property
    def ratio(self) -> float:
        """Tracking error with the estimated over that with the calibrated map."""
        return self.runs[ESTIMATED].rms_m / self.runs[CALIBRATED].rms_m


def draw(found: Compared) -> Figure:
    """Reference on top, the errors below, once more without the largest."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 6.6))
        first, second, third = figure.subplots(3, 1, sharex=True)
        t = DT_S * np.arange(len(found.reference))
        first.plot(t, 1e3 * found.reference[:, 0], color=INK)
        first.set(ylabel="reference in mm", title=f"random boom {found.number}")
        for axis, kinds in ((second, KINDS), (third, KINDS[:2])):
            for kind in reversed(kinds):
                error_mm = 1e3 * found.runs[kind].error_m
                axis.plot(t, error_mm, color=COLOURS[kind], lw=1.0, label=kind)
            axis.set_ylabel("error in mm")
            axis.legend(loc="upper right", ncols=3)
        second.set_title("tracking error")
        third.set_title("the same without the manufacturer's map")
        third.set_xlabel("time in s")
    return figure
