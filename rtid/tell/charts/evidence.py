"""The picture of a verdict: what is left over the regressor of a named effect, before and after it.

Where no effect has a name: over what the rest follows most, time, direction of motion, frequency.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from math import floor, inf, log10

import numpy as np

from rtid.compare import Dependence
from rtid.diagnose.partial import AddedVariable, Exhibit, Rise
from rtid.diagnose.remains import BANDS_HZ, Remainder
from rtid.effects import catalogue
from rtid.effects.page import readable, title
from rtid.plain import FloatArray
from rtid.tell.charts.dependence import SHAPES, over_signal
from rtid.tell.colours import BLUE, CHAMBERS, GREY, MARKERS, ORANGE
from rtid.tell.story import Chart, Dots, Line, Panel
from rtid.tell.words import named
from rtid.units import Z95, flow_name, lpm, scale_of

NAME, REMAINDER = "evidence", "remainder"
MOST_DIGITS = 7  # behind the point


def charts_of(shown: Sequence[Exhibit], rest: Remainder | None = None) -> tuple[Chart, ...]:
    """One for each effect that a diagnosis has found, or one for what no effect explains."""
    names = [NAME if k == 0 else f"{NAME}_{k + 1}" for k in range(len(shown))]
    charts = (replace(evidence(e), name=name) for e, name in zip(shown, names, strict=True))
    return *charts, *([] if rest is None else [left_over(rest)])


def left_over(rest: Remainder) -> Chart:
    """What no effect explains: over the signal that it follows most, time, direction, frequency."""
    names, looks = rest.chambers, zip(rest.chambers, MARKERS, strict=False)
    marks = ", ".join(f"{SHAPES[marker]}: chamber {name}" for name, marker in looks)
    shown = (*rest.signals[:1], rest.time, rest.direction)
    panels = (*(replace(over_signal(names, d), title=_says(d)) for d in shown), _spectrum(rest))
    rows = tuple(panels[k : k + 2] for k in range(0, len(panels), 2))
    heading = "What is left, and no known effect explains"
    caption = f"{rest.text} {marks.capitalize()}." if len(names) > 1 else rest.text
    return Chart(REMAINDER, heading, rows, caption, "none", size_in=(5.2, 2.4))


def _says(depends: Dependence) -> str:
    return f"over {depends.signal}: explains {100 * float(depends.explained.max()):.0f} %"


def _spectrum(rest: Remainder) -> Panel:
    """What is left in each band of frequencies, beside what the sensors' noise leaves there."""
    known = np.flatnonzero(rest.rms_m3s.max(axis=1) > 0.0)
    at = np.arange(len(known), dtype=float)

    def points(name: str, sizes: FloatArray, colour: str, marker: str) -> Dots:
        return Dots(name, at, lpm() * sizes[known], None, colour, marker)

    series = [
        points(f"chamber {name}", rest.rms_m3s[:, c], CHAMBERS[c], MARKERS[c])
        for c, name in enumerate(rest.chambers)
    ]
    noise = points("noise", rest.noise_m3s.max(axis=1), GREY, "c")
    ends = (BANDS_HZ[k + 1] for k in known.tolist())  # words of both ends stood in each other
    ticks = tuple(f"{end:g}" if end < inf else "more" for end in ends)
    title = "size by frequency; circles: noise"
    label = f"rms in {flow_name()}"
    return Panel(title, "frequency up to, Hz", label, points=(*series, noise), ticks=ticks)


def evidence(exhibit: Exhibit) -> Chart:
    """Over the regressor of a named effect, and of its best rival: means with 95 % bars."""
    shown = [exhibit.named, *([exhibit.rival] if exhibit.rival else [])]
    sizes = exhibit.coefficient, None
    panels = tuple(
        _panel(added, size, is_rival=k > 0)
        for k, (added, size) in enumerate(zip(shown, sizes, strict=False))
    )
    heading = f"What is left over the regressor of {named(exhibit.named.key)}"
    return Chart(NAME, heading, (panels,), caption(exhibit), size_in=(5.2, 3.4))


def _panel(added: AddedVariable, size: float | None, is_rival: bool) -> Panel:
    """One regressor: before orange, after blue, and the line of the fitted coefficient."""
    flow, scale = scale_of("m3/s"), scale_of(added.unit)
    per = scale.name.removeprefix(f"{flow.name}/") if added.unit != "1" else flow.name
    if per == scale.name and added.unit != "1":
        per = f"{flow.name} per {scale.name}"
    x_factor = flow.factor / scale.factor

    def points(name: str, trend: Rise, colour: str, marker: str) -> Dots:
        bins = trend.bins
        return Dots(
            name,
            bins.centre * x_factor,
            bins.mean_m3s[:, 0] * flow.factor,
            Z95 * bins.error_m3s[:, 0] * flow.factor,
            colour,
            marker,
            is_joined=False,
            note=_slope(added, trend),
        )

    before = points("before", added.before, ORANGE, "o")
    after = points("after", added.after, BLUE, "s")
    value = added.before.slope if size is None else size
    ends = before.x[[0, -1]] if len(before.x) else before.x
    line = Line("", ends, ends * value * scale.factor, ORANGE, 0.9, is_dashed=True)
    word = "best rival: " if is_rival else ""
    return Panel(
        f"{word}{named(added.key)}",
        f"{regressor(added)} in {per}",
        f"left in {flow.name}",
        lines=(line,),
        points=(before, after),
    )


def regressor(added: AddedVariable) -> str:
    """What the coefficient multiplies, from the effect's page where its equation says so."""
    page = catalogue().get(added.key[0])
    if added.parameter == "share":
        return "what it changes"
    for parameter in page.parameters if page and added.key[0] in catalogue() else ():
        for equation in page.equation if page and parameter.name == added.parameter else ():
            factor = re.search(rf"= -?{re.escape(parameter.symbol)} \* (.+)$", equation)
            if factor:
                return readable(re.sub(r"^\((.*)\)$", r"\1", factor[1]))
    return "regressor"


def caption(exhibit: Exhibit) -> str:
    """What is seen in the picture, in plain words; ± is the 95 % interval."""
    added, rival = exhibit.named, exhibit.rival
    text = (
        f"Over the regressor of {named(added.key)}, all else taken out of both, what is left rises "
        f"by {_slope(added, added.before)} before; once it is in the model, by "
        f"{_slope(added, added.after)}{_level(added)}."
    )
    if exhibit.whole == exhibit.whole:
        whole = _rounded(exhibit.whole, exhibit.whole_sd, added.unit)
        text += (
            " The maps leave of it how it rises with a pressure, and its size goes with that: "
            f"over the whole record it is {whole}."
        )
    if rival is None:
        return text
    kind = "what cannot be told from it" if rival.key[0] in exhibit.alike else "its best rival"
    text += (
        f" Over {kind}, {named(rival.key)}: by {_slope(rival, rival.before)} before, by "
        f"{_slope(rival, rival.after)} after{_level(rival)}."
    )
    if exhibit.instead == exhibit.instead:
        stays = _rounded(exhibit.instead, exhibit.instead_sd, added.unit)
        text += (
            f" With the rival in its place, {title(added.key[0]).lower()} would still have {stays}."
        )
    return text


def _slope(added: AddedVariable, trend: Rise) -> str:
    return _rounded(trend.slope, trend.sd, added.unit)


def _rounded(value: float, sd: float, unit: str) -> str:
    """A value, to the second digit of its 95 % interval, and the interval; of zero too."""
    scale = scale_of(unit)
    half = Z95 * scale.factor * sd
    digits = max(0, 1 - floor(log10(half))) if 0 < half < inf else 3
    name = "" if unit == "1" else f" {scale.name}"
    shown = f"{scale.factor * value:.{digits}f}" if digits < MOST_DIGITS else f"{value:.3g}"
    spread = f"{half:.{digits}f}" if digits < MOST_DIGITS else f"{half:.2g}"
    return f"{shown} ± {spread}{name}"


def _level(added: AddedVariable) -> str:
    """What the slope behind the addition is of the one before."""
    before, after = added.before.slope, added.after
    if abs(after.slope) <= Z95 * after.sd:
        return ", which is none within its interval"
    return f", {100 * abs(after.slope / before):.2g} % of that" if before else ""
