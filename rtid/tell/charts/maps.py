"""Fig. 5: the learned flow over the u-dp plane, and slices through it with their 95 % band."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from rtid.compare.tables import AnyMap
from rtid.estimator.flowmap import VALID, EdgeMap, FlowMap
from rtid.model import NONE, Axes
from rtid.plain import BoolArray, FloatArray
from rtid.tell.axes import HYDRAULIC, joined, labels, second
from rtid.tell.colours import BLUE, INK
from rtid.tell.story import Chart, Dots, Line, Palette, Panel, Plane, Planes, Remark, Strip
from rtid.units import Z95, Scale, flow_name, lpm

FIELDS = 96, 120  # of a plane: over the pressure drop, over the command
SLICES, ROW = 5, 4  # of a map, and pictures beside each other
POINTS, DOTS = 200, 25  # of a slice, and of a reference beside it
LEAST_FLOW = 0.02  # of the largest: what a row of blocks passes that is worth a slice
SURE = 0.98  # quantile of what two maps differ by at which its scale ends
DOUBT = 0.05  # of the largest flow: end of the scale of its interval
_OF_DROPS = (
    "Learned flow over opening command and pressure drop. Outlined blocks stand on their own "
    "data, the others follow the valve's law from these."
)
_OF_RATES = "Learned rate. Outlined blocks stand on their own data."


def _flow() -> str:
    return f"flow in {flow_name()}"


def maps(
    flowmap: FlowMap,
    points: Mapping[str, FloatArray] | None = None,
    axes: Mapping[str, Axes] = MappingProxyType({}),
) -> Planes:
    """Q in L/min, one scale for all valves; veiled where a block is not valid.

    points: of the data by valve, (n, 2) in V and MPa.  axes: by valve, see `rtid.tell.axes`.
    """
    largest = max((np.nan_to_num(edge.q_max_m3s) for edge in flowmap.edges), default=0.0) * lpm()
    top = 1.25 * max(largest, 1e-3)
    planes = tuple(
        replace(
            _plane(edge, over, edge.name, _flow_on(edge), *_scale(over, top)),
            points=(points or {}).get(edge.name),
        )
        for edge, over in _with_axes(flowmap, axes)
    )
    named = [labels(over) for _, over in _with_axes(flowmap, axes)]
    x, y = (joined([pair[k] for pair in named]) for k in (0, 1))
    is_rate = any(over.over is not None for over in axes.values())
    caption = _OF_RATES if is_rate else _OF_DROPS
    caption += " Dots: where the record was." if points else ""
    words = "valid", "not valid" if is_rate else "not valid: from the orifice law"
    return Planes("maps", "Flow maps", planes, x, y, _flow(), caption, *words)


def _with_axes(flowmap: FlowMap, axes: Mapping[str, Axes]) -> list[tuple[EdgeMap, Axes]]:
    return [(edge, axes.get(edge.name, HYDRAULIC)) for edge in flowmap.edges]


def flow_plane(edge: EdgeMap, axes: Axes = HYDRAULIC) -> Plane:
    """The flow of a valve on its own scale."""
    scale = _scale(axes, _top(edge))
    return _plane(edge, axes, f"{edge.name}: {_flow()}", _flow_on(edge), *scale)


def interval_plane(edge: EdgeMap, axes: Axes = HYDRAULIC) -> Plane:
    """Half the 95 % interval of a valve's flow."""
    sd = Z95 * edge.sd(*_lattice(edge)) * lpm()
    title = f"{edge.name}: ± 95 % interval in {flow_name()}"
    return _plane(edge, axes, title, sd, (0.0, DOUBT * _top(edge)), "doubt")


def change_plane(edge: EdgeMap, other: AnyMap, name: str, axes: Axes = HYDRAULIC) -> Plane:
    """The flow of a valve less that of another map, `name`."""
    w, dp = np.broadcast_arrays(*_lattice(edge))
    change = _flow_on(edge) - other.flow(edge.name, w, dp) * lpm()
    known = np.abs(change[np.isfinite(change)])
    most = float(np.quantile(known, SURE)) if len(known) else 1.0
    title = f"{edge.name}: flow less {name}, {flow_name()}"
    return _plane(edge, axes, title, change, (-most, most), "change")


def _flow_on(edge: EdgeMap) -> FloatArray:
    """Flow in the middle of every field of a plane (rows, columns), L/min."""
    return np.asarray(edge.flow(*_lattice(edge)) * lpm())


def _scale(axes: Axes, top: float) -> tuple[tuple[float, float], Palette]:
    """Colours up to a largest flow; a rate has two directions."""
    return ((0.0, top), "flow") if axes.over is None else ((-top, top), "change")


def _top(edge: EdgeMap) -> float:
    q = np.abs(_flow_on(edge))
    return max(float(np.nanmax(q)) if np.isfinite(q).any() else 1.0, 1e-9)


def _lattice(edge: EdgeMap) -> tuple[FloatArray, FloatArray]:
    """Middles of the fields: commands (1, columns), V, and pressure drops (rows, 1), Pa."""
    rows, columns = FIELDS
    return _middles(edge.grid.u_v, columns)[None, :], _middles(edge.grid.dp_pa, rows)[:, None]


def _middles(borders: FloatArray, count: int) -> FloatArray:
    low, high = float(borders[0]), float(borders[-1])
    return low + (high - low) * (np.arange(count) + 0.5) / count


def _plane(
    edge: EdgeMap, axes: Axes, title: str, values: FloatArray, scale: tuple[float, float],
    palette: Palette,
) -> Plane:  # fmt: skip
    u, p, valid = edge.grid.u_v, edge.grid.dp_pa * second(axes).factor, edge.status == VALID
    ends = (float(u[0]), float(u[-1])), (float(p[0]), float(p[-1]))
    return Plane(
        title, *ends, values, *scale, palette, _outline(u, p, valid), _fields(u, p, ~valid)
    )


def _outline(u: FloatArray, p: FloatArray, valid: BoolArray) -> FloatArray:
    """Lines (m, 4) between blocks that are valid and others, from x, y to x, y."""
    framed = np.pad(valid, 1)
    upright = np.argwhere(framed[1:, 1:-1] != framed[:-1, 1:-1])
    level = np.argwhere(framed[1:-1, 1:] != framed[1:-1, :-1])
    lines = [(u[i], p[j], u[i], p[j + 1]) for i, j in upright]
    lines += [(u[i], p[j], u[i + 1], p[j]) for i, j in level]
    return np.array(lines, np.float64).reshape(-1, 4)


def _fields(u: FloatArray, p: FloatArray, chosen: BoolArray) -> FloatArray:
    """Blocks as x, y, width and height (k, 4)."""
    fields = [(u[i], p[j], u[i + 1] - u[i], p[j + 1] - p[j]) for i, j in np.argwhere(chosen)]
    return np.array(fields, np.float64).reshape(-1, 4)


def slices(
    flowmap: FlowMap,
    reference: AnyMap | None = None,
    u_v: Sequence[float] | None = None,
    reference_name: str = "reference",
    axes: Mapping[str, Axes] = MappingProxyType({}),
) -> Chart:
    """Q(dp) at fixed commands, V, with the 95 % band, beside a reference; dashed where not valid.

    u_v: the commands; evenly spread over the valid range of each valve if not given.  axes: by
    valve, see `rtid.tell.axes`; a map of the command alone is shown over the command.
    """
    panels = [
        slice_panel(edge, edge.name, "dp", u_v, reference, reference_name, over)
        for edge, over in _with_axes(flowmap, axes)
    ]
    rows = tuple(tuple(panels[k : k + ROW]) for k in range(0, len(panels), ROW))
    caption = (
        "Slices through the maps with their 95 % band; dashed where a block does not stand on its "
        "own data."
    )
    return Chart("slices", "Slices through the maps", rows, caption, "all", "", (3.6, 2.6))


def slice_panel(
    edge: EdgeMap,
    title: str,
    along: str = "dp",
    at: Sequence[float] | None = None,
    reference: AnyMap | None = None,
    reference_name: str = "",
    axes: Axes = HYDRAULIC,
) -> Panel:
    """Flow over the pressure drop ("dp") at fixed commands `at`, V, or over "u" at drops, Pa.

    axes: of a rate's map, the second quantity in place of the drop; without one always over "u".
    """
    over_drop = along == "dp" and axes.over != NONE
    fixed, free = (edge.grid.u_v, edge.grid.dp_pa)[:: 1 if over_drop else -1]
    by_itself = at is None or axes.over == NONE
    fixed_at = _spread(edge, fixed, over_drop) if by_itself else np.asarray(at, np.float64)
    scales = Scale(axes.command, 1.0), second(axes)
    of_fixed, of_free = scales[:: 1 if over_drop else -1]
    low = max(float(free[0]), 0.0) if axes.over is None else float(free[0])
    cut = _Cut(edge, over_drop, of_free.factor, fixed_at, low, float(free[-1]))
    x, q, sd, valid = cut.flow()
    least = 0.0 if axes.over is None else -np.inf  # a rate has two directions
    ends = () if axes.over == NONE else _ends(x, q, fixed_at, of_fixed)
    lines = (
        Line("extrapolated", _joined(x), _joined(q), BLUE, 0.9, is_dashed=True),
        Line("learned, valid", _joined(x), _joined(np.where(valid, q, np.nan)), BLUE, 2.0),
    )
    strip = Strip(
        "95 % band", _joined(x), _joined(np.maximum(q - sd, least)), _joined(q + sd), BLUE
    )
    dots = cut.dots(reference, reference_name)
    x_label = labels(axes)[int(over_drop)]
    return Panel(title, x_label, _flow(), lines, (dots,), (), ends, (strip,), has_zero=False)


def _ends(x: FloatArray, q: FloatArray, fixed: FloatArray, scale: Scale) -> tuple[Remark, ...]:
    """What each slice is at, behind its end."""
    unit = "" if scale.name == "1" else f" {scale.name}"
    return tuple(
        Remark(float(x[k, -1]), f"{value * scale.factor:.3g}{unit}", INK, y=float(q[k, -1]))
        for k, value in enumerate(fixed)
    )


class _Cut:
    """Straight cuts through the map of a valve."""

    def __init__(
        self, edge: EdgeMap, over_drop: bool, scale: float, fixed: FloatArray, low: float,
        high: float,
    ) -> None:  # fmt: skip
        self._edge, self._over_drop, self._scale = edge, over_drop, scale
        self._fixed, self._ends = fixed, (low, high)

    def _points(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x as it is shown, command, V, and pressure drop, Pa, each (cuts, count)."""
        along, fixed = np.broadcast_arrays(np.linspace(*self._ends, count), self._fixed[:, None])
        w, dp = (fixed, along) if self._over_drop else (along, fixed)
        return along * self._scale, w, dp

    def flow(self) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """x, flow and half its 95 % interval, L/min, and where it is valid, each (cuts, n)."""
        x, w, dp = self._points(POINTS)
        valid = np.asarray(self._edge.status_at(w, dp) == VALID)
        return x, self._edge.flow(w, dp) * lpm(), Z95 * self._edge.sd(w, dp) * lpm(), valid

    def dots(self, reference: AnyMap | None, name: str) -> Dots:
        """Another map on the same cuts; no points without one."""
        if reference is None:
            return Dots("", np.empty(0), np.empty(0), None, INK, "c", is_joined=False)
        x, w, dp = self._points(DOTS)
        q = reference.flow(self._edge.name, w.ravel(), dp.ravel()) * lpm()
        return Dots(name, x.ravel(), np.asarray(q), None, INK, "c", is_joined=False)


def _joined(rows: FloatArray) -> FloatArray:
    """Rows (k, n) behind each other, with NaN between them."""
    return np.pad(rows, ((0, 0), (0, 1)), constant_values=np.nan).ravel()


def _spread(edge: EdgeMap, borders: FloatArray, over_drop: bool) -> FloatArray:
    """Centres of some rows of blocks that are valid somewhere and pass a flow."""
    centre = 0.5 * (borders[1:] + borders[:-1])
    valid = (edge.status == VALID).any(axis=1 if over_drop else 0)
    flow = np.abs(edge.theta[:, :, 0]).max(axis=1 if over_drop else 0)
    some = np.flatnonzero(valid & (flow > LEAST_FLOW * flow.max(initial=1e-30)))
    some = some if len(some) else np.arange(len(centre))
    return centre[some[np.unique(np.linspace(0, len(some) - 1, SLICES).round().astype(int))]]
