"""Mean residual of every chamber over bins of a signal, with its 95 % interval."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColumnDataSource, Range1d, Whisker

from rtid.colours import CHAMBERS, GREY, MARKERS, UNITS
from rtid.compare import Dependence
from rtid.model import FloatArray
from rtid.ui.theme import plot
from rtid.units import LPM

Z95 = 1.96
ROOM = 0.06  # of the span, free at either end


class DependencePlot:
    """A right model lies on the zero line; a trend says what it misses."""

    def __init__(self, chambers: Sequence[str]) -> None:
        self._chambers = chambers
        self._x, self._y = Range1d(0, 1), Range1d(0, 1)
        self.root = plot("L/min", x_range=self._x, y_range=self._y)
        self.root.hspan(0.0, line_color=GREY, line_width=0.6)
        self._bins: list[ColumnDataSource] = []
        for colour, marker, _ in zip(CHAMBERS, MARKERS, chambers, strict=False):
            source = ColumnDataSource({"x": [], "mean": [], "low": [], "high": []})
            shape = ("circle", "square")[marker == "s"]
            self.root.scatter("x", "mean", source=source, marker=shape, color=colour, size=6)
            self.root.line("x", "mean", source=source, color=colour, line_width=0.8)
            whisker = Whisker(base="x", lower="low", upper="high", source=source)
            whisker.line_color, whisker.upper_head, whisker.lower_head = colour, None, None
            self.root.add_layout(whisker)
            self._bins.append(source)

    def show(
        self, found: Dependence, what: str = "residual", beside: Dependence | None = None
    ) -> None:
        """The residual over one signal; beside: another that has the same scale."""
        unit, factor = UNITS.get(found.unit, (found.unit, 1.0))
        x = found.centre * factor
        mean, error = found.mean_m3s * LPM, Z95 * found.error_m3s * LPM
        for c, source in enumerate(self._bins):
            low, high = mean[:, c] - error[:, c], mean[:, c] + error[:, c]
            source.data = {"x": x, "mean": mean[:, c], "low": low, "high": high}
        self._x.update(**_reach(x))
        shown = [found] if beside is None else [found, beside]
        self._y.update(**_reach(np.concatenate([_ends(one) for one in shown])))
        shares = ", ".join(
            f"{100 * share:.0f} % of {name} ({shape})"
            for name, share, shape in zip(
                self._chambers, found.explained, ("round", "square"), strict=False
            )
        )
        self.root.title.text = f"{what} over {found.signal}: explains {shares}"
        self.root.xaxis.axis_label = f"{found.signal} in {unit}" if unit else found.signal


def _ends(found: Dependence) -> FloatArray:
    mean, error = found.mean_m3s * LPM, Z95 * found.error_m3s * LPM
    return np.concatenate([mean - error, mean + error]).ravel()


def _reach(values: FloatArray) -> dict[str, float]:
    """The span of values with some room, or 0 to 1 where there is none."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    room = ROOM * (high - low) or 0.5
    return {"start": low - room, "end": high + room}
