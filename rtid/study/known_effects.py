"""Learn the maps of a record beside effects that are known: those of a fitted revision.

What the diagnosis' fit says of the compliances and of the effects' coefficients, N(s, S), takes the
place of what the record's own sums say of them; with the maps m and their products with the shared
unknowns G_sm,

    G_ss = S^-1 + G_sm G_mm^-1 G_ms,        r_s = S^-1 s + G_sm G_mm^-1 r_m,

so that the joint solution has s and S as they are told, and the maps are fitted beside them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from rtid.diagnose.clean import usable
from rtid.diagnose.excuse import steady
from rtid.diagnose.fit import NO_COV, Fit
from rtid.diagnose.fitted_sizes import parameters
from rtid.diagnose.report import Value
from rtid.diagnose.residual import effect_values, transformed_like
from rtid.diagnose.standing import fitted
from rtid.effects.column import Candidate
from rtid.effects.extra import with_extra_flow
from rtid.effects.laws import cause_of
from rtid.effects.laws.response import behind_s, with_lag
from rtid.effects.record_view import MapTerms as KnownMap
from rtid.effects.record_view import RecordView
from rtid.effects.terms import terms_of
from rtid.errors import RtidError
from rtid.estimator.factor import SHARED_PRIOR, factor_of, one_thread
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.limits import refuse_unfit
from rtid.estimator.misfit import count_misfit
from rtid.estimator.published import publish
from rtid.estimator.record import RecordFit, run
from rtid.estimator.solution import solve
from rtid.estimator.sums import Sums
from rtid.model import Lag, Machine, Signal
from rtid.plain import FloatArray, plain
from rtid.project import Project
from rtid.study.kept_record import MessageAges, Replay, taught_s, within
from rtid.trace.reading import Trace

ALL = (-math.inf, math.inf)
# share by which the terms of one effect may differ from each other; a hundredth of a per cent,
# beside a compliance that nothing tells, was more than a factor has digits for (air on a sweep)
ALONE = 1e-3


class TooManyEffectsError(RtidError):
    """More effects than the kernels have room for."""


@dataclass(frozen=True)
class KnownEffect:
    """An effect of the model as fitted to a record; parameters: SI.

    follows: its flow is that of the simulated pressures where pressures are simulated; False where
    it is taken from the measured ones.
    """

    effect: str
    where: str
    parameters: dict[str, Value]
    follows: bool


@dataclass(frozen=True)
class Acting:
    """The machine with the effects of a fitted revision.

    model: with terms of the effects, each for theta = 1, and behind timings with split commands;
    chunk (n, 2 + signals): the record as it reaches the spools; of (terms,): the effect that each
    term belongs to.
    measured: the effects whose flow is taken from the measured pressures, not from simulated ones.
    """

    model: Machine
    chunk: FloatArray
    of: tuple[Candidate, ...]
    measured: tuple[Candidate, ...]


def acting(fit: Fit, chunk: FloatArray, published: FlowMap | None = None) -> Acting:
    """The machine of a fit and its effects on a record, chunk (n, 2 + signals), SI, as declared.

    published: a map that also knows blocks which the fit has not visited, for effects that act on
    the valves' flows.  Raises TooManyEffectsError.
    """
    if not (fit.revision.effects or fit.revision.timings):
        return Acting(fit.declared, chunk, (), ())
    sent = transformed_like(fit, chunk)
    model = with_positive_pressures(fit.model, sent)
    view = RecordView.of(model, sent, fit.weights, fit.map, fit.view)
    if published is not None:
        of_terms = model.with_taylor_maps
        known = everywhere(of_terms, published)
        view = RecordView.of(of_terms, sent, fit.weights, known, fit.view)
    if fit.revision.replaces_lag:
        model = replace(model, lag=Lag())
    if lag_s := behind_s(fit.revision.timings):
        if len(fit.revision.timings) == 1:  # nor to the commands: they are not split
            model, sent = fit.declared, sent[:, : chunk.shape[1]]
        model = with_lag(model, lag_s, view.step_s)
    of, measured = list[Candidate](), list[Candidate]()
    for effect, value in effect_values(fit):
        terms = terms_of(view.model, view.compliance, effect, value)
        model = replace(model, terms=(*model.terms, *terms))
        if not terms:
            ones, name = np.ones(len(model.terms)), f"{effect.effect} {effect.where}"
            flow = _flow(view, effect, value)
            model, _, sent = with_extra_flow(model, ones, sent, flow, name)
            measured.append(effect)
        of += [effect] * (len(model.terms) - len(of))
    try:
        refuse_unfit(model)
    except ValueError as error:
        raise TooManyEffectsError(f"too many effects: {error}", "drop one: rtid drop") from None
    return Acting(model, sent, tuple(of), tuple(measured))


def everywhere(model: Machine, published: FlowMap) -> KnownMap:
    """A published map as the diagnosis takes maps, all blocks known."""
    cells = [math.prod(edge.grid.shape) for edge in model.maps]
    rated = np.repeat([edge.rated_q_m3s for edge in model.maps], cells)
    return KnownMap(np.arange(model.n_cells), published.theta_cells() / rated[:, None], NO_COV)


def with_positive_pressures(model: Machine, chunk: FloatArray) -> Machine:
    """The model with ranges of the chambers' pressures that end above zero where the record does.

    chunk (n, 2 + signals), SI.  What is the inverse of a pressure needs that.
    """
    chambers = {chamber.pressure for chamber in model.chambers}

    def above_zero(signal: Signal) -> Signal:
        lowest = float(chunk[:, 2 + model.column(signal.name)].min())
        return replace(signal, minimum=0.5 * lowest) if signal.minimum <= 0 < lowest else signal

    signals = (above_zero(s) if s.name in chambers else s for s in model.signals)
    return replace(model, signals=tuple(signals))


def _flow(view: RecordView, effect: Candidate, value: float) -> FloatArray:
    """What an effect adds to every chamber by the measured pressures (n - 1, chambers), m3/s."""
    flow = np.zeros((view.n - 1, len(view.model.chambers)))
    for c, volume in cause_of(view, effect).column(effect.shape).items():
        flow[:, c] += value * volume / view.dt_s
    return flow


def learn_beside(fit: Fit, machine: Acting, chunk: FloatArray) -> RecordFit:
    """The maps of a record beside what a fit says of all that they share.

    fit: with the blocks excused that miss the flow (`steady`); chunk (n, 2 + signals): the part of
    the machine's record that teaches.
    """
    model, weights = machine.model, fit.weights
    state = run(model, chunk, weights)
    counters, sums = state.counters, Sums.ended(state)
    del state  # its tables are large
    solution = solve(model, told(sums, *_told(fit, machine)), counters=counters)
    solution = count_misfit(model, chunk, weights, solution)
    lag_sd_s = fit.lag_sd_s if np.isfinite(fit.lag_sd_s) else 0.0
    return RecordFit(solution, weights, lag_sd_s, np.zeros(0), np.zeros(0))


def learn_acting(
    fit: Fit, chunk: FloatArray, taught: tuple[float, float] = ALL
) -> tuple[Acting, RecordFit]:
    """The machine with the effects of a steady fit, and the maps that the taught span gives it.

    chunk (n, 2 + signals), SI, as declared; taught: s.  Twice where an effect acts on the valves'
    flows: the maps know blocks that the fit had to leave out, and the effect acts there as well.
    """
    acts = acting(fit, chunk)
    record = learn_beside(fit, acts, within(acts.chunk, taught))
    if acts.measured:
        acts = acting(fit, chunk, publish(record.solution))
        record = learn_beside(fit, acts, within(acts.chunk, taught))
    return acts, record


def replayed(
    project: Project, present: Fit, machine: Machine, trace: Trace, ages: MessageAges
) -> tuple[Replay, Fit]:
    """A record learned from beside its one fit, with the effects that its project has added.

    With it the steady fit, of all that its maps share.  machine: as declared, with the noise of its
    sensors.
    """
    fit = steady(present)
    whole = usable(fit.declared, trace.chunk(machine))
    acts, record = learn_acting(fit, whole, taught_s(project))
    record = _judged(present, record)
    added = known_effects(present, acts, [section.key for section in project.sections.parts])
    record = replace(record, offsets_s=ages.offsets_s, offsets_sd_s=ages.sd_s)
    made = held_against(project, fit.declared, fit, machine, trace, record, added)
    return made, fit


def learned(model: Machine, chunk: FloatArray) -> RecordFit:
    """What a record, chunk (n, 2 + signals), SI, tells of a machine that nothing was added to."""
    present = fitted(model, chunk)
    fit = steady(present)
    return _judged(present, learn_acting(fit, fit.chunk)[1])


def _judged(present: Fit, record: RecordFit) -> RecordFit:
    """The maps beside the steady fit, judged by the one that excuses few blocks."""
    solution = replace(record.solution, rho=present.rho, dof=round(present.freedom))
    return replace(record, solution=solution)


def held_against(
    project: Project,
    fine: Machine,
    fit: Fit | None,
    machine: Machine,
    trace: Trace,
    record: RecordFit,
    added: tuple[KnownEffect, ...],
) -> Replay:
    """A record beside what was learned from it.

    fine: the machine on the grids of the fit; fit: the steady one, None where it has no effects.
    """
    chunk = usable(fine, trace.chunk(machine))
    acts = acting(fit, chunk) if fit is not None else Acting(fine, chunk, (), ())
    if fit is not None and acts.measured:  # on flows that the map knows where the fit has none
        acts = acting(fit, chunk, publish(record.solution))
    held_out_s = project.sections.record.validation_s
    spans = taught_s(project), held_out_s
    return Replay(project, machine, acts.model, trace, record, acts.chunk, *spans, added)


def as_json(added: tuple[KnownEffect, ...]) -> list[dict[str, Any]]:
    """The effects in plain JSON types, SI; numbers that are not finite are null."""
    return [plain(asdict(known)) for known in added]


def known_effects(
    fit: Fit, acts: Acting, keys: Iterable[tuple[str, str]]
) -> tuple[KnownEffect, ...]:
    """The effects of a fit by their names and places, effects and timings alike."""
    simulates = fit.declared.has_pressures  # no pressure is simulated of other plants
    apart = {effect.key for effect in acts.measured} if simulates else set()
    return tuple(KnownEffect(*key, parameters(fit, key), key not in apart) for key in keys)


def _told(fit: Fit, acts: Acting) -> tuple[FloatArray, FloatArray]:
    """Shared unknowns (n,) and their covariance: compliances in weights' units, then the terms."""
    n_c = len(fit.model.chambers)
    used = [*range(1, 1 + n_c), *(fit.column(effect) for effect in acts.of)]
    at = [fit.estimate.used.index(column) for column in used]
    value = np.array([fit.held.value(column) for column in used])
    unit = np.concatenate([np.ones(n_c), value[n_c:]])
    cov = fit.estimate.cov[np.ix_(at, at)] / np.outer(unit, unit)
    cov[np.diag_indices(len(at))] += ALONE**2 * (np.arange(len(at)) >= n_c)
    return value / unit, cov


def told(sums: Sums, theta: FloatArray, cov: FloatArray) -> Sums:
    """The sums with N(theta, cov) for what they say of the shared unknowns (n_shared,).

    The residual at the solution stays what the rows leave; nothing is left to correct for noise.
    """
    ns = sums.n_shared
    own, right, cross = sums.shared[1:, 1:], sums.right, sums.crossed
    with one_thread():
        follow = factor_of(sums.maps_alone()).theta(np.column_stack([cross, right[ns:]]))
    information = np.linalg.inv(cov)
    known = information - SHARED_PRIOR * np.eye(ns) + cross.T @ follow[:, :ns]
    drawn = information @ theta + cross.T @ follow[:, ns]
    shared = np.zeros_like(sums.shared)
    shared[1:, 1:], shared[1:, 0], shared[0, 1:] = known, drawn, drawn
    # both misfits have in common what they say of the maps
    shared[0, 0] = sums.shared[0, 0] - 2 * (right[:ns] - drawn) @ theta
    shared[0, 0] += theta @ (own - known) @ theta
    return replace(sums, shared=shared, noise=np.zeros_like(sums.noise))
