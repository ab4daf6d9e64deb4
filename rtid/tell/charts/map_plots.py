"""Pictures of a flow map: planes over command and pressure drop, slices with their band."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.layouts import column
from bokeh.models import ColorBar, ColumnDataSource, LinearColorMapper, Range1d, Title
from bokeh.plotting import figure

from rtid.compare import Reference
from rtid.estimator.flowmap import VALID, EdgeMap
from rtid.plain import FloatArray
from rtid.tell.charts.theme import INK_TAG, plot, styled
from rtid.tell.colours import BLUE, GREY, ORANGE
from rtid.units import LPM, MPA, Z95

SLICES = 5


class Plane:
    """An image over command and pressure drop, the valid blocks outlined."""

    def __init__(self, heading: str, palette: Any) -> None:
        self._x, self._y = Range1d(0, 1), Range1d(0, 1)
        self._title = styled(Title(text=heading or " "))
        made: figure = plot("drop in MPa", "opening command in V", self._x, y_range=self._y)
        made.title = self._title
        made.grid.visible = False
        self._image = ColumnDataSource({"q": [], "x": [], "y": [], "w": [], "h": []})
        self._mapper = LinearColorMapper(palette=list(palette), nan_color="#dddddd")
        made.image(
            image="q", x="x", y="y", dw="w", dh="h", source=self._image, color_mapper=self._mapper
        )
        self._outline = ColumnDataSource({"x0": [], "y0": [], "x1": [], "y1": []})
        made.segment("x0", "y0", "x1", "y1", source=self._outline, line_color="#ffffff",
                     line_width=2.4)  # fmt: skip
        made.segment("x0", "y0", "x1", "y1", source=self._outline, line_color="#22272b")
        bar = ColorBar(color_mapper=self._mapper, width=9, padding=4, label_standoff=4)
        bar.major_label_text_font_size, bar.bar_line_color = "10px", None
        made.add_layout(bar, "right")
        self.root = column(made, sizing_mode="stretch_both")

    def show(
        self,
        edge: EdgeMap,
        values: FloatArray,
        low: float,
        high: float,
        palette: Any,
        title: str,
    ) -> None:
        """values (dp, u) of a valve on a scale from low to high, all in the quantity's unit."""
        u, p = edge.grid.u_v, edge.grid.dp_pa * MPA
        self._mapper.update(palette=list(palette), low=low, high=high)
        self._image.data = {
            "q": [values], "x": [u[0]], "y": [p[0]], "w": [u[-1] - u[0]], "h": [p[-1] - p[0]],
        }  # fmt: skip
        self._outline.data = _borders(edge)
        self._title.text = f"{edge.name}: {title}"
        self._x.update(start=float(u[0]), end=float(u[-1]))
        self._y.update(start=float(p[0]), end=float(p[-1]))


def _borders(edge: EdgeMap) -> dict[str, list[float]]:
    """Between blocks that are valid and others."""
    u, p, framed = edge.grid.u_v, edge.grid.dp_pa * MPA, np.pad(edge.status == VALID, 1)
    upright = np.argwhere(framed[1:, 1:-1] != framed[:-1, 1:-1])
    level = np.argwhere(framed[1:-1, 1:] != framed[1:-1, :-1])
    lines = [(u[i], p[j], u[i], p[j + 1]) for i, j in upright]
    lines += [(u[i], p[j], u[i + 1], p[j]) for i, j in level]
    columns = np.array(lines).reshape(-1, 4).T.tolist()
    return dict(zip(("x0", "y0", "x1", "y1"), columns, strict=True))


class Slices:
    """Flow at fixed commands over the pressure drop, or the other way round."""

    def __init__(self) -> None:
        self._title = styled(Title(text=" "))
        self._reach = Range1d(0, 1)
        made = plot("L/min", " ", self._reach)
        made.title, made.y_range.start = self._title, 0.0
        self._axis = made.xaxis[0]
        self._band = ColumnDataSource({"xs": [], "ys": []})
        self._law = ColumnDataSource({"xs": [], "ys": []})
        self._own = ColumnDataSource({"xs": [], "ys": []})
        self._other = ColumnDataSource({"x": [], "y": []})
        self._labels = ColumnDataSource({"x": [], "y": [], "text": []})
        made.patches(
            "xs", "ys", source=self._band, fill_color=BLUE, fill_alpha=0.2, line_color=None
        )
        made.multi_line("xs", "ys", source=self._law, line_color=BLUE, line_dash=[4, 3])
        made.multi_line("xs", "ys", source=self._own, line_color=BLUE, line_width=2.2)
        made.scatter("x", "y", source=self._other, size=5, line_color=ORANGE, fill_color=None)
        label = made.text("x", "y", "text", source=self._labels, text_font_size="10px", x_offset=3,
                          text_baseline="middle", text_color=GREY)  # fmt: skip
        label.glyph.tags = [INK_TAG]
        self.root = column(made, sizing_mode="stretch_both")

    def show(self, edge: EdgeMap, along: str, other: Reference | None) -> None:
        """Slices of a valve, beside a reference."""
        over_drop = along == "dp"
        fixed, free = (edge.grid.u_v, edge.grid.dp_pa) if over_drop else (
            edge.grid.dp_pa, edge.grid.u_v)  # fmt: skip
        x = np.linspace(max(free[0], 0.0), free[-1], 200)
        scale, unit = (MPA, "V") if over_drop else (1.0, "MPa")
        parts: dict[str, list[FloatArray]] = {
            k: [] for k in ("bx", "by", "x", "q", "own", "ox", "oq")
        }
        ends, words = [], []
        for at in _spread(edge, fixed, over_drop):
            w, dp = (np.full(len(x), at), x) if over_drop else (x, np.full(len(x), at))
            q, sd = edge.flow(w, dp) * LPM, Z95 * edge.sd(w, dp) * LPM
            parts["bx"].append(np.concatenate([x, x[::-1]]) * scale)
            parts["by"].append(np.concatenate([q - sd, (q + sd)[::-1]]))
            parts["x"].append(x * scale)
            parts["q"].append(q)
            parts["own"].append(np.where(edge.status_at(w, dp) == VALID, q, np.nan))
            if other is not None:
                few = slice(None, None, 8)
                parts["ox"].append(x[few] * scale)
                parts["oq"].append(other.flow(edge.name, w[few], dp[few]) * LPM)
            ends.append((float(x[-1] * scale), float(q[-1])))
            words.append(f"{at if over_drop else at * MPA:.3g} {unit}")
        self._band.data = {"xs": parts["bx"], "ys": parts["by"]}
        self._law.data = {"xs": parts["x"], "ys": parts["q"]}
        self._own.data = {"xs": parts["x"], "ys": parts["own"]}
        flat = {k: np.concatenate([*parts[k], np.empty(0)]) for k in ("ox", "oq")}
        self._other.data = {"x": flat["ox"], "y": flat["oq"]}
        self._labels.data = {"x": [a for a, _ in ends], "y": [b for _, b in ends], "text": words}
        self._title.text = f"{edge.name}: slices with 95 % band" + (
            f", dots: {other.name}" if other else ""
        )
        self._reach.update(start=float(x[0] * scale), end=float(x[-1] * scale * 1.14))
        self._axis.axis_label = "drop in MPa" if over_drop else "opening command in V"


def _spread(edge: EdgeMap, borders: FloatArray, over_drop: bool) -> FloatArray:
    """Centres of some rows of blocks that are valid somewhere and pass a flow."""
    centre = 0.5 * (borders[1:] + borders[:-1])
    valid = (edge.status == VALID).any(axis=1 if over_drop else 0)
    flow = np.abs(edge.theta[:, :, 0]).max(axis=1 if over_drop else 0)
    some = np.flatnonzero(valid & (flow > 0.02 * flow.max(initial=1e-30)))
    some = some if len(some) else np.arange(len(centre))
    return centre[some[np.unique(np.linspace(0, len(some) - 1, SLICES).round().astype(int))]]
