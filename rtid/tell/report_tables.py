"""Tables of a report: coverage of the maps, parameters with their intervals, settings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from math import isfinite

from rtid.compare.tables import CAUSES, cause_of_block
from rtid.diagnose.report import FittedEffect, FoundEffect, Value
from rtid.diagnose.verdict import UNKNOWN
from rtid.effects.page import title
from rtid.estimator.flowmap import VALID, EdgeMap
from rtid.model import Machine
from rtid.tell.axes import place
from rtid.tell.report_story import ReportStory
from rtid.tell.story import Table
from rtid.tell.words import quantity
from rtid.units import flow_name, lpm

BENT = ", if nothing else were missing"  # a modulus that is told beside something unknown


def coverage(story: ReportStory) -> Table:
    """Of every map: how many blocks stand on data, and why the others do not."""
    rows = []
    for edge in story.flowmap.edges:
        why = Counter(
            cause_of_block(str(edge.status[i, j]), edge.reason.get((int(i), int(j)), ""))
            for i in range(edge.status.shape[0])
            for j in range(edge.status.shape[1])
        )
        others = ", ".join(f"{cause} {why[cause]}" for cause in CAUSES[1:] if why[cause])
        known = int((edge.status == VALID).sum())
        rows.append((edge.name, f"{known} of {edge.status.size}", others, _reached(edge)))
    heads = ("map", "blocks on data|", "the others, and why~", "largest flow on data|")
    return Table("Coverage", heads, rows)


def _reached(edge: EdgeMap) -> str:
    largest = edge.q_max_m3s
    return f"{lpm() * largest:.3g} {flow_name()}" if isfinite(largest) else "none"


def parameters(story: ReportStory) -> Table:
    """Bulk moduli, lag of the spools, and every effect, with their 95 % intervals."""
    result, model = story.diagnosed.diagnosis, story.diagnosed.project.model
    rows = [
        (f"bulk modulus, chamber {chamber.name}", _modulus(beta, sd, result.verdict == UNKNOWN))
        for chamber, beta, sd in zip(model.chambers, result.beta_pa, result.beta_sd_pa, strict=True)
        if chamber.pressure
    ]
    if result.lag_s > 0:
        rows.append(("lag of the spools", quantity(Value(result.lag_s, float("nan"), "s"))))
    for effect in result.added:
        rows += _effect(effect, "in the model")
    for found in result.found:
        rows += _effect(found, "found")
    return Table("Parameters, ± is the 95 % interval", ("", ""), rows)


def _modulus(beta_pa: float, sd_pa: float, is_bent: bool) -> str:
    """As a person reads it; beside something unknown nobody knows by how much it is off."""
    return quantity(Value(beta_pa, sd_pa, "Pa")) + (BENT if is_bent else "")


def _effect(effect: FittedEffect | FoundEffect, how: str) -> Iterator[tuple[str, str]]:
    for name, value in effect.parameters.items():
        words = f"{title(effect.effect)} ({effect.where}), {name.replace('_', ' ')}: {how}"
        yield words, quantity(value)


def settings(story: ReportStory) -> list[tuple[str, str]]:
    """What the project file says of the machine and its record, in rows of two."""
    project = story.diagnosed.project
    model, record = project.model, project.sections.record
    parts = [
        f"{word} {span[0]:g} to {span[1]:g} s"
        for word, span in (("learned", record.identification_s), ("judged", record.validation_s))
        if span is not None
    ]
    grids = (f"{e.name} {e.grid.shape[0]} x {e.grid.shape[1]}" for e in model.maps)
    noise = (
        f"{s.name} {quantity(Value(s.noise, float('nan'), s.unit))}"
        for s in model.signals
        if s.noise > 0
    )
    return [
        ("parts of the record", ", ".join(parts) or "not declared"),
        ("grids of the maps", f"{', '.join(grids)} blocks{_ends(model)}"),
        ("noise of the sensors", ", ".join(noise) or "estimated"),
        ("form, filter", f"{model.form}, {model.filter.wn_rad_s / 6.283185307:.3g} Hz"),
    ]


def _ends(model: Machine) -> str:
    """The ranges of the grids, where all have the same."""
    ends = {
        place(model.axes(e), e.grid.u_v[[0, -1]].tolist(), e.grid.dp_pa[[0, -1]].tolist())
        for e in model.maps
    }
    return f", {ends.pop()}" if len(ends) == 1 else ""
