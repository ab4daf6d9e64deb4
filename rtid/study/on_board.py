"""The effects that a project has added, on board: shared columns beside the maps.

An effect that is a function of the signals at one instant is a term of (14) with theta = 1 for the
value in [[added]]; how sure that is counts as a row, (theta - 1) / sd, so that what the motion does
not show stays as it was found.  One whose flow the kernels cannot compute, a user's in Python or of
any other form, is evaluated beside them (`rtid.effects.live`).  Timings, and effects that act on
the valves' flows or have a state of their own, need a record: replay and diagnosis know them; on
board the maps take up what they can of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rtid.effects import Effect, catalogue, correcting
from rtid.effects.law import BEHIND_MAPS, BOTH, GAIN_DRIFT
from rtid.effects.page import DEAD_VOLUME, title
from rtid.effects.summed import RunningSum
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.estimator.limits import refuse_unfit
from rtid.estimator.solution import Solution
from rtid.model import PRESSURE, Machine, Term
from rtid.project import Project
from rtid.project.added import AddedSection, ParameterSection
from rtid.project.build import digest
from rtid.trace.snapshot import SnapshotError, load

if TYPE_CHECKING:
    from rtid.effects.column import Candidate
    from rtid.effects.live import LiveFlow

LEAST_SD, USUAL_SD = 0.01, 0.1  # relative: an oil warms, a seal wears
USUAL_DISTURBANCE = 0.01  # of the rated rate, per sqrt(Hz)
USUAL_RECORD_S = 60.0  # over which a drift was seen, where nothing is declared of its record
WALK_S = 1.0  # after so long a gain that walks has another step


class NoRoomOnBoardError(RtidError):
    """More effects than the kernels have room for."""


def on_board(project: Project, tell: Callable[[str], None]) -> Project:
    """The project whose model holds its added effects, as far as they can run live.

    tell: hears one sentence per effect.  Another model has another digest: what was learned without
    an effect is not gone on with.  Raises NoRoomOnBoardError.
    """
    model, flows = as_found(project), project.flows
    for added in project.sections.parts:
        if model.measured and _is_behind(added):
            model, flows = _behind(project, model, flows, added)
            tell(f"{title(added.effect)} at {added.where} is part of the equation")
            continue
        if model.measured and _walks(added):
            model = _walking(project, model, added)
            tell(
                f"{title(added.effect)} at {added.where} is followed: the maps' gain may change by "
                f"{100 * model.upkeep.gain_walk:.2g} % in a second"
            )
            continue
        name = f"{title(added.effect)} at {added.where}"
        if is_volume(added):
            tell(f"{name} is part of the chamber's volume")
            continue
        terms, more = _live(project, added)
        if terms:
            signals = tuple(flow.signal for flow in more)
            model = _disturbed(model)
            model = replace(model, terms=(*model.terms, *terms), signals=(*model.signals, *signals))
            flows = (*flows, *more)
            how = ", its flow computed sample by sample" if more else ""
            tell(f"{name} is learned beside the maps{how}")
        else:
            tell(
                f"{name} is not in the model on board, {_why_not(project, added)}: the maps take "
                "up what they can of it; replay and diagnosis know it"
            )
    if model is project.model:
        return project
    try:
        refuse_unfit(model)
    except ValueError as error:
        raise NoRoomOnBoardError(f"{project.path}: {error}", "drop an effect: rtid drop") from None
    beside = *(flow.key for flow in flows), *filter(None, [model.upkeep.gain_walk])
    if model.chambers != project.model.chambers:
        beside = *beside, model.chambers
    if model.lag != project.model.lag:
        beside = *beside, model.lag
    key, alone = digest((project.digest, model.terms, *beside)), digest(model)
    return replace(project, model=model, digest=key, machine_digest=alone, flows=flows)


def as_found(project: Project) -> Machine:
    """The machine with the lag and the dead volumes that a record told: none is found on board."""
    model, seen_s = project.model, project.sections.dynamics.spool_lag.seen_s
    if seen_s is not None:
        model = replace(model, lag=replace(model.lag, nominal_s=seen_s))
    for added in filter(is_volume, project.sections.parts):
        model = _with_volume(model, added)
    return model


def is_volume(added: AddedSection) -> bool:
    """Whether it is a volume that the file has not declared."""
    return added.effect == correcting(DEAD_VOLUME)[0].name


def _with_volume(model: Machine, added: AddedSection) -> Machine:
    """The machine with so much more dead volume.

    Learned beside the maps, as a rate of pressure, it trades with the modulus, and what noise makes
    of that is not taken out of it: 320 +- 4 MPa were told where 605 were true.
    """
    (volume,) = added.parameters.values()
    chambers = tuple(
        replace(c, v0_m3=c.v0_m3 + volume.value) if added.where in (c.name, BOTH) else c
        for c in model.chambers
    )
    return replace(model, chambers=chambers)


def _is_behind(added: AddedSection) -> bool:
    """Whether it is a lag behind the maps of a plant whose rate is measured."""
    return _has_law(added, BEHIND_MAPS)


def _is_in_model(added: AddedSection) -> bool:
    """Whether it is a part of the model itself, and no term beside its maps."""
    return is_volume(added) or _is_behind(added) or _walks(added)


def _walks(added: AddedSection) -> bool:
    """Whether it is a drift of the gain of maps that give what is measured."""
    return _has_law(added, GAIN_DRIFT)


def _has_law(added: AddedSection, law: str) -> bool:
    page = catalogue().get(added.effect)
    return page is not None and page.law == law


def _walking(project: Project, model: Machine, added: AddedSection) -> Machine:
    """The machine whose gain walks as far over a record as it was seen to drift: q T = (g T)^2.

    How a gain goes on nobody knows: a battery's had lost 10 % in half a minute, 3 % in the next.
    """
    (rate,) = added.parameters.values()
    begin_s, end_s = project.sections.record.identification_s or (0.0, USUAL_RECORD_S)
    walk = abs(rate.value) * math.sqrt(end_s - begin_s)
    model, every_s = _disturbed(model), model.upkeep.every_s or WALK_S
    return replace(model, upkeep=replace(model.upkeep, every_s=every_s, gain_walk=walk))


def _behind(
    project: Project, model: Machine, flows: tuple[LiveFlow | RunningSum, ...], added: AddedSection
) -> tuple[Machine, tuple[LiveFlow | RunningSum, ...]]:
    """The machine and its running integral with a lag behind the maps."""
    from rtid.effects.laws.response import with_lag  # noqa: PLC0415

    (lag,) = added.parameters.values()
    model = _disturbed(model)
    step_s = min((m.period_s for m in project.assembly.messages if m.period_s), default=1e-3)
    late = (replace(f, behind_s=lag.value) if isinstance(f, RunningSum) else f for f in flows)
    return with_lag(model, lag.value, step_s), tuple(late)


def _disturbed(model: Machine) -> Machine:
    """The machine with what disturbs a rate, beside which sizes that are known weigh what they do.

    It is found in records: where it is not declared a usual one weighs rows.
    """
    if model.has_pressures or model.chambers[0].disturbance > 0.0:
        return model
    usual = USUAL_DISTURBANCE * max(edge.rated_q_m3s for edge in model.edges)
    return replace(model, chambers=(replace(model.chambers[0], disturbance=usual),))


def learned_sizes(board: Project, solution: Solution) -> list[tuple[str, float, float, str]]:
    """Of each term of an added effect: its name, learned size and standard deviation, SI, unit."""
    terms, sds, sizes = board.model.terms, np.sqrt(np.diag(solution.terms_cov)), []
    for added in board.sections.parts:
        effect, key = _effect(board, added), f"{added.effect} {added.where}"
        size = added.parameters.get(effect.size.name) if effect is not None else None
        for term, theta, sd in zip(terms, solution.terms_theta, sds, strict=True):
            if size is not None and f"{term.name} ".startswith(f"{key} "):
                sd_si = float(sd / term.scale * abs(size.value))
                sizes.append((term.name, float(theta * size.value), sd_si, size.unit))
    return sizes


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
        parts = project.sections.parts
        live = tuple(a for a in parts if _is_in_model(a) or _live(project, a)[0])
        return load(path, board.model, board.digest), live


def _live(project: Project, added: AddedSection) -> tuple[tuple[Term, ...], tuple[LiveFlow, ...]]:
    """What of an added effect runs live: its terms, and flows where the kernels lack its form."""
    if _is_nothing(project, added):
        return (), ()
    terms = _terms(project, added)
    flows = () if terms else _flows(project, added)
    if flows:
        size = added.parameters[flows[0].placed.effect.size.name]
        terms = tuple(_known(flow.term, size) for flow in flows)
    return terms, flows


def _is_nothing(project: Project, added: AddedSection) -> bool:
    """Whether its size in the file is zero: a term is a multiple of it."""
    effect = _effect(project, added)
    size = added.parameters.get(effect.size.name) if effect is not None else None
    return size is not None and size.value == 0.0


def _why_not(project: Project, added: AddedSection) -> str:
    if _is_nothing(project, added):
        return "because its size in the file is 0"
    if _column(project, added) is None:
        trusted = (
            "" if project.untrusted is None else f" unless {project.untrusted.name} is trusted"
        )
        return f"because this project knows no such effect{trusted}"
    above_zero = tuple(
        replace(s, minimum=max(s.minimum, 1.0)) if s.kind == PRESSURE else s
        for s in project.model.signals
    )
    if _terms(replace(project, model=replace(project.model, signals=above_zero)), added):
        return "where the declared range of a chamber's pressure does not begin above zero"
    return "because it needs a record"


def _terms(project: Project, added: AddedSection) -> tuple[Term, ...]:
    """The terms of an added effect; () where it is no function of signals that the kernels know."""
    # a daemon that has no effects starts without all that refits them
    from rtid.effects.terms import terms_of  # noqa: PLC0415

    model, candidate = project.model, _column(project, added)
    if candidate is None:
        return ()
    size = added.parameters[candidate.parameter]
    compliance = np.full(len(model.chambers), 1.0 / model.beta_nominal_pa)
    return tuple(_known(t, size) for t in terms_of(model, compliance, candidate, size.value))


def _flows(project: Project, added: AddedSection) -> tuple[LiveFlow, ...]:
    """The flows of an added effect that are evaluated beside the kernels; () where they cannot."""
    from rtid.effects.live import live_flows  # noqa: PLC0415

    model, candidate = project.model, _column(project, added)
    if candidate is None:
        return ()
    compliance = np.full(len(model.chambers), 1.0 / model.beta_nominal_pa)
    size = added.parameters[candidate.parameter]
    return live_flows(model, compliance, candidate, size.value)


def _column(project: Project, added: AddedSection) -> Candidate | None:
    """The column that an added effect was found with; None for one that is no effect here."""
    from rtid.effects.column import of_page  # noqa: PLC0415

    effect = _effect(project, added)
    if effect is None or effect.size.name not in added.parameters:
        return None
    names = tuple(p.name for p in effect.shapes)
    given = added.parameters
    effect = effect.at_size(given[effect.size.name].value)
    shape = tuple(given[name].value if name in given else 0.0 for name in names)
    return replace(of_page(effect, added.where, shape=names), shape=shape)


def _effect(project: Project, added: AddedSection) -> Effect | None:
    """The effect of that name, of the user's or of the catalogue."""
    named = {effect.name: effect for effect in project.effects}
    return named.get(added.effect) or catalogue().get(added.effect)


def _known(term: Term, size: ParameterSection) -> Term:
    """A term that is known as well as the size of its effect."""
    sd = size.sd
    relative = max(LEAST_SD, sd / abs(size.value) if sd is not None else USUAL_SD)
    return replace(term, sd=relative)
