"""Fig. 5 drawn: flow over pressure drop at fixed commands, with 95 % bands, and the errors."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
from matplotlib.figure import Figure

from benchmarks.paper.slices import Z95, Slice
from rtid.tell.colours import BLUE, INK
from rtid.tell.stills import STYLE
from rtid.units import LPM, MPA

EVERY = 12  # points between two circles of the truth


def draw(slices: Sequence[Slice]) -> Figure:
    """The maps on the left, what they miss on the right."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.7))
        maps, misses = figure.subplots(1, 2)
        for s in slices:
            dp = s.dp_pa * MPA
            for axis, middle in ((maps, s.flow), (misses, s.flow - s.true)):
                band = (middle - Z95 * s.sd) * LPM, (middle + Z95 * s.sd) * LPM
                axis.fill_between(dp, *band, color=BLUE, alpha=0.2, lw=0)
                axis.plot(dp, middle * LPM, color=BLUE, lw=1.2)
            maps.plot(dp[::EVERY], s.true[::EVERY] * LPM, "o", ms=3, mfc="white", mec=INK, mew=0.7)
            maps.annotate(f"{s.w_v:g} V", (dp[-1], s.flow[-1] * LPM), fontsize=8)
        misses.axhline(0.0, color=INK, lw=0.7)
        maps.set(ylabel="flow in L/min", title="learned (lines), calibrated (circles)")
        misses.set(ylabel="learned less calibrated, L/min", title="error with its 95 % band")
        misses.set_ylim(-0.5, 0.5)
        for axis in (maps, misses):
            axis.set_xlabel("pressure drop in MPa")
    return figure
