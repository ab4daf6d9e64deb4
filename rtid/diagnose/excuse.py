"""Blocks whose terms miss the flow lose their say, in the one fit that everything reads.

Where six terms cannot follow a map, as at the corner of the dead band, few blocks of many miss the
flow: they are excused (`rtid.estimator.missed`), and effects are judged by the others.  A missing
effect is seen in most blocks: to excuse them all would excuse the effect (a delay of 3 ms left
rho 0.97 of 246).  So effects are judged by rows of which only few are excused, `few_excused`, and
what is told of the compliances and the lag comes from `steady`, which lets no block bend them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.diagnose.commands import split
from rtid.diagnose.fit import Fit, columns_of_effects, fit, one_pass
from rtid.diagnose.residual import effect_values
from rtid.effects.extra import with_extra_flow
from rtid.effects.laws import total_softness
from rtid.estimator.limits import most_open
from rtid.estimator.misfit import Misfit, can_be_explained, residual_of, widened
from rtid.estimator.missed import excusing, misses
from rtid.estimator.record import summed
from rtid.estimator.solution import sketch
from rtid.model import Machine
from rtid.plain import FloatArray

# of the visited blocks: 1 in 100 on clean records, 4 in 10 with a leak of 2 % of the flow
FEW = 0.1
LEAST = -0.9  # of a chamber's volume, that a fitted one may take off it
TINY = 1e-300
KNOWN = 1e-4  # share by which the flow of an effect may differ from what is fitted


def few_excused(present: Fit) -> Fit:
    """The fit with the blocks excused that miss the flow, as it is where they are many."""
    return _excused(present, FEW)


def steady(present: Fit) -> Fit:
    """The fit with all blocks excused that miss the flow: its compliances and its lag are told."""
    return _excused(present, 1.0)


def rho_of_all(present: Fit) -> float:
    """The rho of a fit where it is, when every block has its say."""
    if not present.weights.missed.any():
        return present.rho
    weights = replace(present.weights, missed=np.zeros_like(present.weights.missed))
    record = present.declared, present.chunk, weights, present.revision
    return one_pass(*record, present, bank=False, thorough=False).rho


def _excused(present: Fit, most: float) -> Fit:
    """A fit without the say of blocks that miss the flow, where they are at most such a share."""
    if present.weights.missed.any() or not can_be_explained(present.sent):
        return present
    rest = left_over(present.unfactored())
    present = present.leaving(rest)
    missing = misses(present.model, rest)
    if not 0.0 < missing.share <= most:
        return present
    weights = excusing(present.model, present.sent, present.weights, rest, missing.hot)
    if not weights.missed.any():  # it comes and goes too fast to be the block's
        return present
    return fit(present.declared, present.chunk, weights, present.revision, present, bank=False)


def left_over(present: Fit) -> Misfit:
    """What the maps of a fit leave of its record beside its effects."""
    if present.rest is not None:
        return present.rest
    record = *_machine(present), present.weights
    return residual_of(*record, sketch(record[0], summed(*record)))


def counted(present: Fit) -> FloatArray:
    """Covariance of the compliances (chambers, chambers), 1/Pa2, what the blocks miss counted.

    The noise's alone of a record that cannot be explained.
    """
    if present.known_cov is not None:
        return present.known_cov
    if not can_be_explained(present.sent):
        return present.compliance_cov
    record = *_machine(present), present.weights
    known = present.rest.estimate if present.rest is not None else None
    estimate = known or sketch(record[0], summed(*record))
    covariance = estimate.influence[:, : len(estimate.scale_pa)]
    covariance = covariance * np.outer(estimate.scale_pa, estimate.scale_pa)
    covariance = covariance * widened(*record, estimate) + _by_sizes(present)
    return _no_less(covariance, present.compliance_cov)


def counting(present: Fit) -> Fit:
    """The fit, which knows that covariance from now on."""
    return present.knowing(known_cov=counted(present))


def _no_less(covariance: FloatArray, least: FloatArray) -> FloatArray:
    """A covariance (n, n), widened to the deviations of another one where these are larger.

    Either way to the noise's own is a first order of how much of it the maps take along.  Where
    steps leave little beside them these differ: 1102.2 +- 0.7 and +- 1.5 MPa, of 1112.1.
    """
    ratio = least.diagonal() / np.maximum(covariance.diagonal(), TINY)
    more = np.sqrt(np.maximum(1.0, ratio))
    return np.asarray(covariance * np.outer(more, more))


def _by_sizes(present: Fit) -> FloatArray:
    """What the sizes of its effects leave open of the compliances (chambers, chambers), 1/Pa2.

        J S J',   J = C_cs C_ss^-1,

    where C is the covariance of compliances c and of all else s, as the noise gives it, and S that
    of s which is told.  A dead volume and the modulus of its chamber are one trade-off: of 900.6
    888.6 +- 0.4 MPa was told, as if the volume were known, which was off by two of its deviations.
    """
    cov, n_c = present.estimate.cov, len(present.model.chambers)
    sizes = present.estimate.used[n_c:]
    sd = np.sqrt(np.maximum(np.diag(cov)[n_c:], TINY))
    s = cov[n_c:, n_c:] / np.outer(sd, sd)
    by = (cov[:n_c, n_c:] / sd) @ np.linalg.pinv(s, hermitian=True)
    by *= present.weights.compliance[:, None]
    spreads = dict(present.spreads)
    more = np.array([spreads.get(column, 0.0) for column in sizes]) / sd
    return np.asarray(by @ (max(1.0, present.rho) * s + np.diag(more**2)) @ by.T)


def _with_room(present: Fit) -> Machine:
    """The machine of a fit, with room for as many blocks as where it is split.

    Edges of either direction may be open at once there: memory that began anew at other moments
    would judge a fit with a timing by another measure than one without.
    """
    model, most = present.model, most_open(split(present.declared))
    room = model.recent_blocks - (most - most_open(model))
    return replace(model, recent_blocks=max(room, 2 * most))


def _machine(present: Fit) -> tuple[Machine, FloatArray]:
    """The machine of a fit, what its effects add to the flows being known, and the record."""
    machine = _with_room(present)
    if not present.revision.effects:
        return machine, present.sent
    machine, flow = _storing(present, machine)
    volumes = zip(columns_of_effects(present), effect_values(present), strict=True)
    for columns, (_, value) in volumes:
        for c, volume in columns.items():
            flow[:, c] += value * volume / present.view.dt_s
    present.view.rest()
    model, _, chunk = with_extra_flow(machine, np.zeros(0), present.sent, flow)
    return replace(model, terms=tuple(replace(term, sd=KNOWN) for term in model.terms)), chunk


def _storing(present: Fit, machine: Machine) -> tuple[Machine, FloatArray]:
    """The machine whose volumes take up what its effects do, and flows that take that back.

    Flows (n - 1, chambers), m3/s.  A pressure's noise moves all that is stored: where most of a
    dead volume is fitted, 3 times the variance was left, as if all blocks missed the flow.
    """
    flow = np.zeros((present.view.n - 1, len(machine.chambers)))
    if not machine.has_pressures:
        return machine, flow
    taken = total_softness(present.view, effect_values(present)).mean(axis=0)
    chambers = list(machine.chambers)
    for c, chamber in enumerate(chambers):
        if taken[c] != 0.0 and chamber.pressure:
            volume = max(float(taken[c] / present.weights.compliance[c]), LEAST * chamber.v0_m3)
            chambers[c] = replace(chamber, v0_m3=chamber.v0_m3 + volume)
            rise = np.diff(present.sent[:, 2 + machine.column(chamber.pressure)])
            flow[:, c] = volume * present.compliance[c] * rise / present.view.dt_s
    return replace(machine, chambers=tuple(chambers)), flow
