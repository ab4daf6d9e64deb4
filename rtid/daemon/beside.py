"""The effects that a project has added, on board: shared columns beside the maps.

An effect that is a function of the signals at one instant is a term of (14) with theta = 1 for the
value in [[added]]; how sure that is counts as a row, (theta - 1) / sd, so that what the motion does
not show stays as it was found.  Timings, and effects that act on the valves' flows or have a state
of their own, need a record: replay and diagnosis know them; on board the maps take up what they can
of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from rtid.compare.acting import terms_of
from rtid.diagnose.candidates import Candidate
from rtid.diagnosed_text import title
from rtid.effects import catalogue
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.estimator.limits import refuse_unfit
from rtid.model import Model, Term
from rtid.project import Project
from rtid.project.added import AddedSection
from rtid.project.build import digest
from rtid.store import SnapshotError, load

LEAST_SD, USUAL_SD = 0.01, 0.1  # relative: an oil warms, a seal wears


class TooManyEffectsError(RtidError):
    """More effects than the kernels have room for."""


def on_board(project: Project, tell: Callable[[str], None]) -> Project:
    """The project whose model holds its added effects, as far as they can run live.

    tell: hears one sentence per effect.  Another model has another digest: what was learned without
    an effect is not gone on with.  Raises TooManyEffectsError.
    """
    model = project.model
    for added in project.sections.added:
        terms, name = _terms(project.model, added), f"{title(added.effect)} at {added.where}"
        if terms:
            model = replace(model, terms=(*model.terms, *terms))
            tell(f"{name} is learned beside the maps")
        else:
            tell(
                f"{name} is not in the model on board, {_why_not(added.effect)}: the maps take up "
                "what they can of it; replay and diagnosis know it"
            )
    if model is project.model:
        return project
    try:
        refuse_unfit(model)
    except ValueError as error:
        raise TooManyEffectsError(f"{project.path}: {error}", "drop an effect: rtid drop") from None
    return replace(project, model=model, digest=digest(model))


def load_for(path: Path, project: Project) -> tuple[Estimator, tuple[AddedSection, ...]]:
    """A snapshot of this project, from replay or from on board; the effects that are in its model.

    Raises SnapshotError.
    """
    board = on_board(project, lambda _: None)
    try:
        return load(path, project.model, project.digest), ()
    except SnapshotError:
        if board is project:
            raise
        live = tuple(a for a in project.sections.added if _terms(project.model, a))
        return load(path, board.model, board.digest), live


def _why_not(effect: str) -> str:
    if effect == "entrained_air":
        return "where the declared range of a chamber's pressure does not begin above zero"
    return "because it needs a record"


def _terms(model: Model, added: AddedSection) -> tuple[Term, ...]:
    """The terms of an added effect; () where it cannot run live."""
    page = catalogue().get(added.effect)
    if page is None or not page.parameters:
        return ()
    size, *shape = (parameter.name for parameter in page.parameters)
    found = added.parameters
    size = size if size in found else next(iter(found))
    values = tuple(found[name].value if name in found else 0.0 for name in shape)
    candidate = Candidate(added.effect, added.where, size, found[size].unit, np.inf, shape=values)
    compliance = np.full(len(model.chambers), 1.0 / model.beta_nominal_pa)
    terms = terms_of(model, compliance, candidate, found[size].value)
    value, sd = found[size].value, found[size].sd
    relative = max(LEAST_SD, sd / abs(value) if sd is not None else USUAL_SD)
    return tuple(replace(term, sd=relative) for term in terms)
