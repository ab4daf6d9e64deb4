"""Map: the learned flow of a valve with its uncertainty, slices through it, beside a reference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np

from rtid.compare import PAPER_DP_PA, PAPER_U_V, LearnedReference, Reference, deviations
from rtid.estimator.flowmap import VALID, EdgeMap, FlowMap
from rtid.maps.files import formats
from rtid.model import Axes
from rtid.plain import FloatArray
from rtid.tell.axes import axes_of, labels
from rtid.tell.charts.maps import change_plane, flow_plane, interval_plane, slice_panel
from rtid.tell.charts.theme import beside
from rtid.tell.html import choice, select, table, text
from rtid.tell.live import PanelPlot, PlanePlot
from rtid.tell.story import Panel
from rtid.ui.desk_views import Bench
from rtid.ui.release_form import FLASHED, MOST_FILES, ReleaseWish, controls, shown
from rtid.ui.views import PageView
from rtid.units import MPA, Z95, flow_name, lpm

NOTHING = "nothing"
CHOICES = ("edge", "beside", "along", "second")
SECOND = ("95 % interval", "difference")


@dataclass(frozen=True)
class _Other(LearnedReference):
    """Another valve's map, whichever valve is asked for."""

    edge: str = ""

    def flow(self, edge: str, w_v: Any, dp_pa: Any) -> FloatArray:
        """Of the other valve."""
        return self.flowmap.flow(self.edge, w_v, dp_pa)


class MapView(PageView):
    """Two planes, flow and its interval or difference, the slices, and the release."""

    places = ("tools", "tools release", "plot", "says")

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        opened = bench.session.opened
        self._reference = reference = opened.reference if opened else None
        self.edge = self.flowmap.edges[0].name
        self.along, self.second = next(iter(self._alongs)), SECOND[0]
        self.beside = reference.name if reference else NOTHING
        edge = self.flowmap[self.edge]
        self._flow, self._second = (
            PlanePlot(plane, *labels(self._axes))
            for plane in (flow_plane(edge, self._axes), interval_plane(edge, self._axes))
        )
        self._slices = PanelPlot(self._cut(edge, None))
        self.roots = {"plot": beside(self._flow.root, self._second.root, self._slices.root)}
        self.wish = ReleaseWish()
        self.actions = {what: partial(self.choose, what) for what in CHOICES}
        self.actions |= {f.name: partial(self.want, f.name) for f in fields(ReleaseWish)}
        self.actions |= {"release": lambda _: bench.session.release(self.wish)}

    @property
    def flowmap(self) -> FlowMap:
        """The map of the newest revision."""
        return self.look.flowmap

    @property
    def _axes(self) -> Axes:
        """What the valve's map is over."""
        return axes_of(self.look.model)[self.edge]

    @property
    def _alongs(self) -> dict[str, str]:
        """What the slices may be over."""
        over = "the pressure drop" if self._axes.over is None else self._axes.over
        return ({f"over {over}": "dp"} if over else {}) | {"over the command": "u"}

    @property
    def others(self) -> dict[str, Reference]:
        """Everything that the map can be held beside, by name."""
        references: dict[str, Reference] = (
            {self._reference.name: self._reference} if self._reference else {}
        )
        for edge in self.flowmap.edges:
            if edge.name != self.edge:
                name = f"valve {edge.name}"
                references[name] = _Other(name, self.flowmap, edge.name)
        return references

    def choose(self, what: str, asked: dict[str, str]) -> None:
        """Another valve, reference, direction of the slices, or second plane."""
        name = asked.get("name", "")
        if what == "edge" and name in [e.name for e in self.flowmap.edges]:
            self.edge = name
        elif what == "beside":
            self.beside = name
        elif what == "along" and name in self._alongs:
            self.along = name
        elif what == "second" and name in SECOND:
            self.second = name
        self.refresh()

    def want(self, what: str, asked: dict[str, str]) -> None:
        """Another format, room, size or flashed file of a release."""
        self.wish = replace(self.wish, **{what: asked.get("name", "")})

    def refresh(self) -> None:
        """Draw what is chosen."""
        if self.beside not in self.others:
            self.beside = NOTHING
        if self.along not in self._alongs:
            self.along = next(iter(self._alongs))
        edge, other = self.flowmap[self.edge], self.others.get(self.beside)
        self._flow.show(flow_plane(edge, self._axes), labels(self._axes))
        if self.second == SECOND[1] and other is not None:
            second = change_plane(edge, other, self.beside, self._axes)
        else:
            second = interval_plane(edge, self._axes)
        self._second.show(second, labels(self._axes))
        self._slices.show(self._cut(edge, other))

    def _cut(self, edge: EdgeMap, other: Reference | None) -> Panel:
        """Slices, beside a reference; without one its points are none."""
        dots = f", dots: {other.name}" if other else ""
        title = f"{edge.name}: slices with 95 % band{dots}"
        along = self._alongs[self.along]
        return slice_panel(edge, title, along, None, other, self.beside, self._axes)

    def fragments(self) -> Mapping[str, str]:
        """Tools, and what the pictures say."""
        tools = (
            choice("edge", [e.name for e in self.flowmap.edges], self.edge)
            + select("beside", [NOTHING, *self.others], self.beside, "beside")
            + select("second", list(SECOND), self.second, "second plane")
            + select("along", list(self._alongs), self.along, "slices")
        )
        valid = float(np.mean(self.flowmap[self.edge].status == VALID))
        kind, rest = "Valve", "follow the orifice law from these"
        if self._axes.over is not None:
            kind, rest = "Map", "go on as these bend"
        says = (
            f"{kind} <b>{text(self.edge)}</b>: outlined blocks ({100 * valid:.0f} % of the grid) "
            "stand on their own data; the others (dashed in the slices, in brackets in the table) "
            f"{rest}, and their interval says how far to trust them. "
            "Next: hold it beside a reference or another valve, or release it."
        )
        released = self.bench.session.offered
        below = shown(released) if released else self._table()
        asked = controls(self.wish, formats(), self._there())
        return {"tools": tools, "release": asked, "says": says + below}

    def _there(self) -> list[str]:
        """Files of the record's folder that may be what is flashed, the newest first."""
        trace = self.bench.session.trace
        paths = [p for s in FLASHED for p in trace.parent.glob(f"*{s}")] if trace else []
        recent = sorted(paths, key=lambda p: -p.stat().st_mtime)
        return [p.name for p in recent if p != trace][:MOST_FILES]

    def _table(self) -> str:
        """Table 1 of the paper for this valve."""
        edge, other = self.flowmap[self.edge], self.others.get(self.beside)
        u, p = edge.grid.u_v, edge.grid.dp_pa
        us = [w for w in PAPER_U_V if u[0] <= w <= u[-1]]
        ps = [d for d in PAPER_DP_PA if p[0] <= d <= p[-1]]
        if not us or not ps:
            return ""
        reference = other or LearnedReference("itself", self.flowmap)
        single = FlowMap((edge,))
        points = deviations(single, reference, us, ps)[0]
        cells = []
        for k in range(len(points.w_v)):
            words = f"{points.flow_m3s[k] * lpm():.2f} ± {Z95 * points.sd_m3s[k] * lpm():.2f}"
            if other is not None and np.isfinite(points.reference_m3s[k]):
                words += (
                    f" | {points.reference_m3s[k] * lpm():.2f} ({100 * points.share[k]:+.1f} %)"
                )
            cells.append(text(words if points.status[k] == VALID else f"({words})"))
        rows = [
            (f"{d * MPA:g} MPa", *(cells[i * len(ps) + j] for i in range(len(us))))
            for j, d in enumerate(ps)
        ]
        head = (f"flow in {flow_name()} ± 95 %" + (f" | {self.beside}" if other else ""),
                *(f"{w:g} {self._axes.command}" for w in us))  # fmt: skip
        return table(head, rows, "figures")
