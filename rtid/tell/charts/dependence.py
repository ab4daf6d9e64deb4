"""What the residual depends on: its mean over bins of every signal, by direction and over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rtid.compare import Dependence
from rtid.compare.dependence import DIRECTIONS
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.tell.colours import BLUE, CHAMBERS, MARKERS, ORANGE, UNITS
from rtid.tell.story import Chart, Dots, Panel
from rtid.units import Z95, flow_name, lpm

COLUMNS = 2
APART = 0.006, 0.1  # of the span, and of a step: between the points of two chambers
SHOWN = 0.96  # of the error bars lie wholly within the scale
SHAPES = {"o": "round", "s": "square"}
LOOKS = ((ORANGE, "o"), (BLUE, "s"))  # of the model before and after


def over_signal(chambers: Sequence[str], dependence: Dependence) -> Panel:
    """The residual of every chamber over one signal, or by the direction of motion."""
    by_name = dependence.signal == "direction"
    unit, factor = UNITS.get(dependence.unit, (dependence.unit, 1.0))
    x = np.arange(len(dependence.rows), dtype=float) if by_name else dependence.centre * factor
    apart = APART[1] if by_name else APART[0] * (float(np.ptp(x)) if len(x) else 1.0)
    points = tuple(
        _points(f"chamber {name}", x + (c - 0.5 * (len(chambers) - 1)) * apart, dependence, c,
                (CHAMBERS[c], MARKERS[c]), not by_name)
        for c, name in enumerate(chambers)
    )  # fmt: skip
    shares = ", ".join(
        f"{100 * share:.0f} % of {name} ({SHAPES[marker]})"
        for name, share, marker in zip(chambers, dependence.explained, MARKERS, strict=False)
    )
    label = "" if by_name else f"{dependence.signal} in {unit}" if unit else dependence.signal
    title = f"residual over {dependence.signal}: explains {shares}"
    ticks = _directions(dependence) if by_name else ()
    return Panel(title, label, f"residual in {flow_name()}", points=points, ticks=ticks)


def dependences(
    model: Machine, signals: Sequence[Dependence], direction: Dependence, time: Dependence
) -> Chart:
    """One panel per signal: mean residual with its 95 % error bars, one scale for all panels."""
    names = [chamber.name for chamber in model.chambers]
    panels = [over_signal(names, dependence) for dependence in (*signals, direction, time)]
    rows = tuple(tuple(panels[k : k + COLUMNS]) for k in range(0, len(panels), COLUMNS))
    caption = "A right model lies on the zero line; a trend says what it misses."
    return Chart("dependence", "What the residual depends on", rows, caption)


def before_and_after(
    chambers: Sequence[str],
    models: Mapping[str, Sequence[Dependence]],
    floor_m3s: float,
    caption: str,
) -> Chart:
    """Two signals per row, one panel per chamber; models: the same signals for one or two models.

    floor_m3s: rms of the sensors' noise, shown as a band.
    """
    limit = _scale([result for every in models.values() for result in every])
    pairs = [
        [
            _compared(name, c, dict(zip(models, result, strict=True)), floor_m3s, limit)
            for c, name in enumerate(chambers)
        ]
        for result in zip(*models.values(), strict=True)
    ]
    rows = tuple(
        tuple(panel for pair in pairs[k : k + COLUMNS] for panel in pair)
        for k in range(0, len(pairs), COLUMNS)
    )
    band, heading = "± rms of the sensors' noise", "What the residual depends on"
    return Chart("dependences", heading, rows, caption, "all", band, (4.2, 2.2))


def _compared(
    chamber: str, c: int, models: Mapping[str, Dependence], floor_m3s: float, limit: float
) -> Panel:
    """One chamber over one signal."""
    first = next(iter(models.values()))
    unit, factor = UNITS.get(first.unit, (first.unit, 1.0))
    points = tuple(
        _points(title, result.centre * factor, result, c, look, True,
                f"explains {100 * result.explained[c]:.0f} %")
        for (title, result), look in zip(models.items(), LOOKS, strict=False)
    )  # fmt: skip
    label = f"{first.signal} in {unit}" if unit else first.signal
    title = f"chamber {chamber} over {first.signal}"
    return Panel(title, label, f"residual in {flow_name()}", points=points, band=floor_m3s * lpm(),
                 limit=limit)  # fmt: skip


def _points(
    name: str, x: FloatArray, dependence: Dependence, c: int, look: tuple[str, str],
    is_joined: bool, note: str = "",
) -> Dots:  # fmt: skip
    mean, error = dependence.mean_m3s[:, c] * lpm(), Z95 * dependence.error_m3s[:, c] * lpm()
    return Dots(name, x, mean, error, *look, is_joined=is_joined, note=note)


def _directions(dependence: Dependence) -> tuple[str, ...]:
    return tuple(
        DIRECTIONS[0 if high < 0 else 2 if low > 0 else 1]
        for low, high in zip(dependence.low, dependence.high, strict=True)
    )


def _scale(result: Sequence[Dependence]) -> float:
    """One scale for all panels, with every mean; bins of few rows may have longer error bars."""
    means = np.concatenate([np.abs(d.mean_m3s).ravel() for d in result])
    ends = np.concatenate([(np.abs(d.mean_m3s) + Z95 * d.error_m3s).ravel() for d in result])
    most = max(1.1 * means.max(), 1.4 * np.quantile(ends, SHOWN)) if len(means) else 1.0
    return float(lpm() * most)
