"""The pictures of a comparison, one set per map, in a folder."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rtid.study.compared import IDENTIFICATION, Held, TraceComparison
from rtid.tell.axes import axes_of
from rtid.tell.charts.correlation import correlogram, cusum
from rtid.tell.charts.dependence import dependences
from rtid.tell.charts.maps import maps, slices
from rtid.tell.charts.over_time import beside, pressures, residual
from rtid.tell.story import Chart

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(studies: Sequence[TraceComparison], folder: Path, suffix: str) -> list[Path]:
    """Draw every map of every study; the files written, names that tell map and picture."""
    from rtid.tell import stills  # noqa: PLC0415 - matplotlib only where it is wanted

    folder.mkdir(parents=True, exist_ok=True)
    drawn: dict[str, Figure] = {}
    for comparison in studies:
        drawn |= _of_study(
            comparison, "" if comparison is studies[0] else f"_{comparison.held[0].name}"
        )
    maps_of = [(comparison, tested) for comparison in studies for tested in comparison.held]
    charts = dict(chart for pair in maps_of for chart in _of_map(*pair))
    if len(maps_of) > 1:
        examined = {tested.name: tested.examinations for _, tested in maps_of}
        charts["beside"] = beside(studies[0].replay.model, examined)
    drawn |= {name: stills.draw(chart) for name, chart in charts.items()}
    return [stills.save(fig, folder / f"{_safe(name)}.{suffix}") for name, fig in drawn.items()]


def _of_study(comparison: TraceComparison, ending: str) -> dict[str, Figure]:
    from rtid.tell import stills  # noqa: PLC0415
    from rtid.tell.charts.where import residual_map  # noqa: PLC0415

    model = comparison.replay.model
    drawn: dict[str, Figure] = {}
    for title, rows in comparison.blocks_of.items():
        drawn[f"where_{title}{ending}"] = residual_map(model, rows)
    drawn[f"maps{ending}"] = stills.draw(maps(comparison.flowmap, axes=axes_of(model)))
    name = comparison.reference.name if comparison.reference else ""
    cut = slices(comparison.flowmap, comparison.reference, None, name, axes_of(model))
    drawn[f"slices{ending}"] = stills.draw(cut)
    return drawn


def _of_map(comparison: TraceComparison, tested: Held) -> Iterator[tuple[str, Chart]]:
    model, examined = comparison.replay.model, tested.examinations
    yield f"residual_{tested.name}", residual(model, tested.parts)
    runs = {title: e.simulations for title, e in examined.items() if e.simulations}
    if runs:
        yield f"pressure_{tested.name}", pressures(model, runs)
    if examined:
        yield f"cusum_{tested.name}", cusum({t: e.cusums for t, e in examined.items()})
    for title, e in examined.items():
        word = tested.name if title == IDENTIFICATION else f"{tested.name}_{title}"
        if e.signals:
            yield f"dependence_{word}", dependences(model, e.signals, e.direction, e.time)
        if e.correlations:
            yield f"correlation_{word}", correlogram(e.correlations)


def _safe(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)
