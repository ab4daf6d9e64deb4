"""A replayed trace beside the effects that its project has added, and what is said of them.

The effects are fitted to the identification part as the diagnosis does it, shapes and timings from
the project file on; maps, and all that is said of them, are learned beside them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rtid.compare.beside import KnownEffect, acting, known_effects, learn_beside
from rtid.comparing_json import plain
from rtid.diagnose.clean import as_measured, usable
from rtid.diagnose.fit import Fit, fit, prepare
from rtid.diagnose.parts import recall
from rtid.diagnosed_text import quantity, title
from rtid.diagnosing import added_parts
from rtid.estimator.published import publish
from rtid.project import Project
from rtid.replay import Progress, Replay, replay

PLAIN_SHARE = 0.4  # of the time, that the replay without effects takes


def _silent(_text: str, _share: float) -> None:
    pass


def replay_beside(
    project: Project, path: Path, progress: Progress = _silent, bus_speed: float | None = None
) -> Replay:
    """`replay` with the effects of [[added]] in the model; as it is where there are none.

    Raises PartError where the record has no column for one of them.
    """
    if not project.sections.added:
        return replay(project, path, progress, bus_speed)
    found = replay(project, path, lambda t, s: progress(t, PLAIN_SHARE * s), bus_speed)
    progress("fitting the added effects", PLAIN_SHARE)
    found = beside(found)
    progress("done", 1.0)
    return found


def beside(found: Replay) -> Replay:
    """A plain replay learned anew beside the effects that its project has added."""
    parts = added_parts(found.project)
    learned = usable(found.model, found.part(found.identification_s))
    declared = replace(as_measured(found.model, learned), own_effects=found.project.effects)
    weights = prepare(declared, learned)
    fitted = fit(declared, learned, weights, recall(declared, learned, weights, parts), bank=False)
    return learned_beside(found, fitted.light(), [part.key for part in parts])


def learned_beside(found: Replay, fitted: Fit, keys: Iterable[tuple[str, str]]) -> Replay:
    """A plain replay learned anew beside the effects and timings of a fitted revision."""
    chunk = usable(fitted.declared, found.chunk)
    machine = acting(fitted, chunk)
    result = replace(found, model=machine.model, chunk=machine.chunk)
    record = learn_beside(fitted, machine, result.part(found.identification_s))
    if machine.measured:  # they may act on flows where the fit has none, and the map now has
        result = replace(result, chunk=acting(fitted, chunk, publish(record.solution)).chunk)
    offsets = found.fit.offsets_s, found.fit.offsets_sd_s
    record = replace(record, offsets_s=offsets[0], offsets_sd_s=offsets[1])
    return replace(result, fit=record, added=known_effects(fitted, machine, keys))


def as_json(added: tuple[KnownEffect, ...]) -> list[dict[str, Any]]:
    """The effects in plain JSON types, SI; numbers that are not finite are null."""
    return [plain(asdict(known)) for known in added]


def sentences(added: tuple[KnownEffect, ...]) -> Iterator[str]:
    """What the model has beside its maps, and what the free run can say of it."""
    for known in added:
        sizes = ", ".join(
            f"{name.replace('_', ' ')} {quantity(v)}" for name, v in known.parameters.items()
        )
        yield f"The model has {title(known.effect)} at {known.where}: {sizes}."
    apart = [title(known.effect) for known in added if not known.follows]
    if apart:
        yield (
            f"The flow of {', '.join(apart)} is taken from the measured pressures, also where "
            "pressures are simulated: these are no free run of it."
        )
