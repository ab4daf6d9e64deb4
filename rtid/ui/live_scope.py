"""The instruments of the live page as SVG: scope, planes of the valves, trends over hours."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from statistics import median

from rtid.daemon.calendar import TrendLine, TrendPoint
from rtid.daemon.status import BlockPlane, EdgeHealth, Scope, SignalHealth
from rtid.model import COMMAND, POSITION, PRESSURE
from rtid.tell.html import text
from rtid.units import MPA, Z95, scale_of

KEPT_S = 60.0
DECIMALS = {"Pa": 1, "s": 2}  # of a value as it is shown
SLIDE_S = 1.0  # between two statuses: the newest second comes in from the right meanwhile
VAGUE = 5.0  # of the usual deviation of a trend's points
GAP = 5.0  # of the usual time between two points of a trend
WIDE, HIGH, PAD = 600.0, 88.0, 8.0
COLOURS = ("var(--bar)", "var(--before)", "var(--good)", "var(--lit)", "var(--open)")
KINDS = {COMMAND: "command", PRESSURE: "pressures", POSITION: "position"}
MOST_DOTS = 240
Ends = tuple[float, float]


class Recent:
    """The last minute of a daemon's scope; take() is told every status, once."""

    def __init__(self) -> None:
        self._bins: deque[tuple[float, dict[str, Ends]]] = deque()

    def take(self, scope: Scope) -> None:
        """One second more; a clock that went back begins anew."""
        if scope.t_s and self._bins and scope.t_s[0] < self._bins[0][0]:
            self._bins.clear()
        newest = self._bins[-1][0] if self._bins else -1.0
        for k, t in enumerate(scope.t_s):
            if t > newest:
                values = {n: (scope.low[n][k], scope.high[n][k]) for n in scope.low}
                self._bins.append((t, values))
        while self._bins and self._bins[-1][0] - self._bins[0][0] > KEPT_S + SLIDE_S:
            self._bins.popleft()

    def __len__(self) -> int:
        return len(self._bins)

    def scopes(self, signals: Iterable[SignalHealth]) -> str:
        """One plot of each kind of signal, smallest to largest value of every tenth of a second."""
        if len(self) < 2:
            return ""
        parts = []
        for kind, title in KINDS.items():
            mine = [s for s in signals if s.kind == kind and s.name in self._bins[-1][1]]
            if mine:
                parts.append(self._plot(title, mine))
        return "".join(parts)

    def _plot(self, title: str, signals: Sequence[SignalHealth]) -> str:
        scale = scale_of(signals[0].unit)
        names = [s.name for s in signals]
        ends = [e for _, values in self._bins for n in names for e in values.get(n, ())]
        low, high = _reach(ends)
        end = self._bins[-1][0] - SLIDE_S
        drawn = ""
        for name, colour in zip(names, COLOURS, strict=False):
            points = [
                (WIDE * (1 + (t - end) / KEPT_S), *v[name]) for t, v in self._bins if name in v
            ]
            drawn += _band(points, low, high, colour)
        keys = ", ".join(
            f'<span style="color:{c}">■</span> {text(n)}'
            for n, c in zip(names, COLOURS, strict=False)
        )
        words = f"{scale.factor * low:.3g} to {scale.factor * high:.3g} {scale.name}"
        slide = f'<g class="slide">{drawn}</g>'
        return (
            f'<p class="key">{title}: {keys}; {text(words)}, last {KEPT_S:.0f} s</p>'
            f"{_svg(slide, f'{title} over the last minute')}"
        )

    def plane(self, edge: EdgeHealth) -> str:
        """Blocks of a valve's map by what became of them, and where the machine was just now."""
        plane = edge.plane
        if plane is None:
            return ""
        u0, u1, p0, p1 = plane.u_v[0], plane.u_v[-1], plane.dp_pa[0], plane.dp_pa[-1]

        def x(u: float) -> float:
            return 180.0 * (u - u0) / (u1 - u0)

        def y(p: float) -> float:
            return 120.0 * (p1 - p) / (p1 - p0)

        drawn, n = dict.fromkeys(FILLS, ""), len(plane.dp_pa) - 1
        for k, code in enumerate(plane.codes):
            i, j = divmod(k, n)
            if code in FILLS:
                left, top = x(plane.u_v[i]), y(plane.dp_pa[j + 1])
                right, below = x(plane.u_v[i + 1]), y(plane.dp_pa[j])
                drawn[code] += f"M{left:.1f},{top:.1f}H{right:.1f}V{below:.1f}H{left:.1f}Z"
        blocks = "".join(
            f'<path d="{shape}" fill="{FILLS[code]}" fill-opacity=".45"/>'
            for code, shape in drawn.items()
            if shape
        )
        dots = "".join(
            f'<circle cx="{x(u):.1f}" cy="{y(p):.1f}" r="1.6" fill="var(--ink)"/>'
            for u, p in self._points(plane)
            if u0 <= u <= u1 and p0 <= p <= p1
        )
        frame = '<rect width="180" height="120" fill="none" stroke="var(--line)"/>'
        words = f"{u0:.3g} to {u1:.3g} V, {MPA * p0:.3g} to {MPA * p1:.3g} MPa"
        return (
            f'<figure class="plane"><svg viewBox="0 0 180 120" role="img" aria-label="plane of '
            f'{text(edge.name)}">{blocks}{frame}{dots}</svg><figcaption class="key"><b>'
            f"{text(edge.name)}</b> {text(words)}</figcaption></figure>"
        )

    def _points(self, plane: BlockPlane) -> list[tuple[float, float]]:
        """Opening command and pressure drop in the middle of each tenth of a second."""
        asked = (plane.command, plane.source, plane.sink)
        made = []
        for _, values in list(self._bins)[-MOST_DOTS:]:
            if all(name in values for name in asked):
                u, source, sink = (0.5 * sum(values[name]) for name in asked)
                made.append((plane.direction * u, source - sink))
        return made


FILLS = {"v": "var(--bar)", "l": "var(--open)"}


def trends(lines: Iterable[TrendLine]) -> str:
    """What was learned over hours with its 95 % bands, one plot for what is of one kind."""
    known = [line for line in lines if len(line.points) > 1]
    kinds: dict[tuple[str, str], list[TrendLine]] = {}
    for line in known:
        kinds.setdefault((line.unit, line.name.split()[0]), []).append(line)
    ends = [t for line in known for t in (line.points[0][0], line.points[-1][0])]
    return "".join(_trend_plot(kind, min(ends), max(ends)) for kind in kinds.values())


def _trend_plot(lines: Sequence[TrendLine], t0: float, t1: float) -> str:
    """Bands and means from t0 to t1, unix_s; a time without values is a gap."""
    low, high = _reach([end for line in lines for end in _ends(line.points)])
    drawn, keys, scale = "", [], scale_of(lines[0].unit)
    for line, colour in zip(lines, COLOURS, strict=False):
        for points in _pieces(line.points):
            at = [(WIDE * (t - t0) / max(t1 - t0, 1.0), v, Z95 * sd) for t, v, sd in points]
            drawn += _band([(x, v - d, v + d) for x, v, d in at], low, high, colour, 0.3)
            drawn += _band([(x, v, v) for x, v, _ in at], low, high, colour)
        _, value, sd = line.points[-1]
        name = line.name.replace("_", " ")
        said = f"{name} {scale.known(value, sd, DECIMALS.get(line.unit, 4))} {scale.name}"
        keys.append(f'<span style="color:{colour}">■</span> {text(said.rstrip())}')
    words = f"{scale.factor * low:.4g} to {scale.factor * high:.4g}, {(t1 - t0) / 3600.0:.2g} h"
    return (
        f'<p class="key">{", ".join(keys)}; {text(words)}, bands: 95 %</p>'
        f"{_svg(drawn, f'{lines[0].name} over hours')}"
    )


def _ends(points: Sequence[TrendPoint]) -> Iterator[float]:
    """Ends of the bands; what was hardly known, at a start, says nothing of the scale."""
    most = VAGUE * median(sd for _, _, sd in points)
    for _, value, sd in points:
        if sd <= most:
            yield value - Z95 * sd
            yield value + Z95 * sd


def _pieces(points: Sequence[TrendPoint]) -> Iterator[Sequence[TrendPoint]]:
    """The points without the gaps: times that are far longer than usual."""
    steps = [b[0] - a[0] for a, b in pairwise(points)]
    most, first = GAP * median(steps), 0
    for k, step in enumerate(steps, 1):
        if step > most:
            yield points[first:k]
            first = k
    yield points[first:]


def _reach(values: Sequence[float]) -> Ends:
    low, high = min(values, default=0.0), max(values, default=1.0)
    room = 0.05 * (high - low) or 0.5 * abs(high) or 1.0
    return low - room, high + room


def _band(
    points: Sequence[tuple[float, float, float]],
    low: float,
    high: float,
    ink: str,
    opacity: float = 0.8,
) -> str:
    """The ground between two lines: x, lower and upper end."""

    def y(value: float) -> float:
        return PAD / 2 + (HIGH - PAD) * (high - value) / (high - low)

    above = [f"{x:.1f},{y(b) - 0.5:.1f}" for x, _, b in points]
    below = [f"{x:.1f},{y(a) + 0.5:.1f}" for x, a, _ in reversed(points)]
    return f'<polygon points="{" ".join(above + below)}" fill="{ink}" fill-opacity="{opacity}"/>'


def _svg(content: str, label: str) -> str:
    return (
        f'<svg class="scope" viewBox="0 0 {WIDE:.0f} {HIGH:.0f}" preserveAspectRatio="none" '
        f'role="img" aria-label="{label}">{content}</svg>'
    )
