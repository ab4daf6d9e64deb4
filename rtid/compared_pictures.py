"""The pictures of a comparison, one set per map, in a folder."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rtid.comparing import IDENTIFICATION, Held, TraceComparison

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(studies: Sequence[TraceComparison], folder: Path, suffix: str) -> list[Path]:
    """Draw every map of every study; the files written, names that tell map and picture."""
    from rtid.pictures import beside, save  # noqa: PLC0415 - matplotlib only where it is wanted

    folder.mkdir(parents=True, exist_ok=True)
    drawn: dict[str, Figure] = {}
    for found in studies:
        drawn |= _of_study(found, "" if found is studies[0] else f"_{found.held[0].name}")
    held = [one for found in studies for one in found.held]
    if len(held) > 1:
        examined = {one.name: one.examinations for one in held}
        drawn["beside"] = beside(studies[0].replay.model, examined)
    return [save(figure, folder / f"{_safe(name)}.{suffix}") for name, figure in drawn.items()]


def _of_study(found: TraceComparison, ending: str) -> dict[str, Figure]:
    from rtid.pictures import maps, residual_map, slices  # noqa: PLC0415

    model = found.replay.model
    drawn: dict[str, Figure] = {}
    for held in found.held:
        drawn |= _of_map(found, held)
    for title, rows in found.blocks_of.items():
        drawn[f"where_{title}{ending}"] = residual_map(model, rows)
    drawn[f"maps{ending}"] = maps(found.flowmap)
    name = found.reference.name if found.reference else ""
    drawn[f"slices{ending}"] = slices(found.flowmap, found.reference, reference_name=name)
    return drawn


def _of_map(found: TraceComparison, held: Held) -> dict[str, Figure]:
    from rtid.pictures import (  # noqa: PLC0415
        correlogram,
        cusum,
        dependences,
        pressures,
        residual,
    )

    model, examined = found.replay.model, held.examinations
    drawn = {f"residual_{held.name}": residual(model, held.parts)}
    runs = {title: e.simulations for title, e in examined.items() if e.simulations}
    if runs:
        drawn[f"pressure_{held.name}"] = pressures(model, runs)
    if examined:
        drawn[f"cusum_{held.name}"] = cusum({t: e.cusums for t, e in examined.items()})
    for title, e in examined.items():
        word = held.name if title == IDENTIFICATION else f"{held.name}_{title}"
        if e.signals:
            figure = dependences(model, e.signals, e.direction, e.time)
            drawn[f"dependence_{word}"] = figure
        if e.correlations:
            drawn[f"correlation_{word}"] = correlogram(e.correlations)
    return drawn


def _safe(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)
