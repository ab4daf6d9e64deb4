"""Whether a cause on trial deserves its place: what refutes it, what is too little, what hides.

A cause is refuted where its form, an oil or the noise alone would have to be impossible; it is too
little where it explains a small part of what is left; and what the residual hardly shows may have
been taken in by the maps (`consequence`).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from firmware_bridge.samples import GAP
from rtid.diagnose.attenuation import stands_apart
from rtid.diagnose.consequence import ALIKE, HIDDEN_GAIN, Consequence, consequence, is_stable
from rtid.diagnose.fit import MATCH_RHO, Fit, one_pass
from rtid.diagnose.residual import Residual, residual
from rtid.diagnose.trials import AcceptedEffect, Trial, TrialState, is_at_a_bound
from rtid.diagnose.verdict import NAMED, doubts_about, told_doubts
from rtid.effects.laws.lines import is_sampled, lines_at
from rtid.estimator.validity import Doubt
from rtid.plain import FloatArray, Key

WORSE = 1.02  # held-out residual, as a share, that an immaterial effect may not raise
CLEAR = 1.5  # times the variance of the sensors' noise, from which unseen data show a misfit ...
LEFT = 0.4  # ... of which what explains it may leave so much
FEIGNED = 0.25  # share by which the variance of the sensors' noise may be wrong
NOTICED = 0.01  # of the degrees of freedom: chi2 from which an immaterial effect stays in the model
SHARE = 0.4  # of the misfit left that a cause must explain, once most of the first is explained,
LEAST_SHARE = 0.1  # ... and before


def taken_in(
    present: Fit, now: Fit, trial: Trial, own_flow: float, last: Residual, after: Residual
) -> Consequence | None:
    """What leaving out an effect that the residual hardly shows does; None where that is nothing.

    own_flow: of the rms flow; last, after: residuals without and with it.  One that
    explains most of a misfit beyond the noise's is no matter of taste: where it does so in data
    that have not taught it, no halves are asked, in which a pump's numbers would only trade off.
    One that takes moduli out of what they can be is nothing that the maps have hidden: on a clean
    sweep a line took both from 1030 MPa to 1660 and 1860, stable, and 3 % off the residual.  Nor is
    a flow that the pressures' noise feigns, in either half and on each grid: on another a leak of
    2.0e-12 took 319 of chi2, which is 1.3e-12 +- 0.45e-12 apart from the noise.
    """
    if trial.gain < HIDDEN_GAIN * trial.n_parameters or not is_as_credible(present, now):
        return None
    does = consequence(present, now, own_flow)
    misfit = present.held.sse - present.regression.dof
    is_needed = present.rho >= present.most_rho and trial.gain > SHARE * misfit
    if is_needed and is_seen_again(now, last, after):
        return does
    is_wanted = does.is_material or is_needed
    if not is_wanted or not is_stable(now, trial, is_needed):
        return None
    is_told = is_needed or trial.is_timing or stands_apart(present, now.revision.effects[-1])
    return does if is_told else None


def leaves_more(last: Residual, after: Residual) -> bool:
    """True where unseen data, as far as both judge them, are explained worse than without it."""
    return rise(last, after) > WORSE


def rise(last: Residual, after: Residual) -> float:
    """What the rms that is left is multiplied by, over the rows that both judge; NaN for none."""
    without, with_it = last.at_rows_of(after).rms_m3s, after.at_rows_of(last).rms_m3s
    return with_it / without if without else float("nan")


def is_seen_to_harm(
    state: TrialState, present: Fit, now: Fit, last: Residual, after: Residual
) -> bool:
    """True where unseen data are explained worse with the last cause than without it.

    A held-out part of few moments says so of any cause beside which another one is missing: spools
    of second order, which took 64 % of a misfit beside a leak, had 12 rows against them, in which
    the leak flowed.  So all other parts as long are asked as well, each by maps that the rest has
    taught, and each has one say: the mean of what the rms is multiplied by (geometric).
    """
    if rise(last, after) <= WORSE:  # not where there is nothing that both judge
        return False
    n = len(state.held_out)
    if n > len(state.chunk) // 2:  # or the record judges itself
        return True
    rises = [rise(last, after)]
    for start in range(0, len(state.chunk) - n + 1, n):
        without, with_it = (_of_part(state, fitted, start) for fitted in (present, now))
        rises.append(rise(without, with_it))
    known = [np.log(r) for r in rises if np.isfinite(r) and r > 0.0]
    return not known or float(np.mean(known)) > np.log(WORSE)


def _of_part(state: TrialState, fitted: Fit, start: int) -> Residual:
    """What a fit, learned anew without a part as long as the held-out one, leaves of that."""
    end = start + len(state.held_out)
    rest = [state.chunk[:start], _behind_gap(state.chunk[end:])]
    if state.held_out[0, 0] > state.chunk[-1, 0]:  # it may be any span of the record
        rest.append(_behind_gap(state.held_out))
    record = state.model, np.concatenate(rest), fitted.weights, fitted.revision, None
    return residual(one_pass(*record, bank=False, before=fitted.map), state.chunk[start:end])


def _behind_gap(part: FloatArray) -> FloatArray:
    """A part of a record (n, 2 + signals), SI, of which what is before it tells nothing."""
    part = part.copy()
    part[:1, 1] = part[:1, 1].astype(np.int64) | GAP
    return part


def is_of_another_form(now: Fit) -> bool:
    """True where a form of the last effect ended at a bound of its page, and misfit is left."""
    return now.rho >= now.most_rho and is_at_a_bound(now)


def is_spread_alone(present: Fit, now: Fit, least: float) -> bool:
    """True where an effect only lets the rows be noisier, and explains less than it must.

    chi2 falls with the weights as well, and where ln det of the noise rises by more the rows are
    settled; of that rise chi2 feigns as much as the noise's variance is wrong by.  At 200 Hz a true
    leak took 1421 off chi2, beside an oil of 928 MPa for 1106 that had stood in for it: the noise
    of that rose by 1484, and settled it took 1213.
    """
    fallen, wins = present.excess - now.excess, now.wins_over(present)
    if fallen < least or wins >= least:
        return fallen < least
    return present.settled_chi2 - now.settled_chi2 < least + FEIGNED * (fallen - wins)


def is_refuted(present: Fit, now: Fit, trial: Trial, least: float) -> bool:
    """True for a cause of another form, that explains noise alone, or makes an oil impossible."""
    if not trial.is_timing and (is_of_another_form(now) or is_unsampled(now, trial)):
        return True
    return makes_impossible(present, now) or is_spread_alone(present, now, least)


def is_unsampled(now: Fit, trial: Trial) -> bool:
    """True for a line that rings faster than the samples of the record could show.

    Healthy machines of 50 samples a second had lines of 450 to 825 rad/s: 157 is half of that.
    """
    is_line = trial.key in lines_at(trial.key[1])
    own = [e for e in now.revision.effects if is_line and e.key == trial.key]
    return any(not is_sampled(e.shape[0], now.view) for e in own)


def makes_impossible(present: Fit, now: Fit) -> bool:
    """True for a cause beside which an oil cannot be, by all that is told of it, that could before.

    It takes what another law misses: of a sag that was half explained, a line before a chamber took
    half of the rest, and left 19 GPa of oil there.
    """
    return _is_invalid(told_doubts(now)) and not _is_invalid(told_doubts(present))


def is_as_credible(present: Fit, now: Fit) -> bool:
    """False where what the residual hardly shows makes moduli impossible, or contradict.

    Those that contradict are no licence to make one impossible: on a sweep a leak had left 1112 and
    1289 MPa, of 1075, and a line that took 436 of chi2 left 1326 and 1852.
    """
    before, after = doubts_about(present), told_doubts(now)
    if _is_invalid(after) and not _is_invalid(before):
        return False
    return bool(before) or not after


def _is_invalid(doubts: Iterable[Doubt]) -> bool:
    """True where one of them is of what cannot be."""
    return any(doubt.is_invalid for doubt in doubts)


def is_seen_again(now: Fit, last: Residual, after: Residual) -> bool:
    """True where an effect takes most of what unseen data clearly show beyond their noise.

    now: the fit with it; last, after: what is left of the part that judges, without and with it.
    """
    if not len(after.t_s) or after.t_s[0] < now.chunk[-1, 0]:
        return False
    before, rest, floor = last.rms_m3s**2, after.rms_m3s**2, after.floor_m3s**2
    return before > CLEAR * floor and rest - floor < LEFT * (before - floor)


def is_form_of_another(state: TrialState, key: Key) -> bool:
    """True for a cause that was not told from one that was found.

    Beside it, what it takes is what the other's form misses: a gap that widens with pressure was
    named a leak, and a relief valve too.
    """
    return any(key in f.alike for f in state.found)


def is_within_a_form(state: TrialState, trial: Trial) -> bool:
    """True for a cause that a law found before would leave if it were a tenth off.

    chi2 goes with the square of what it explains.  No law of a page is known better than that: an
    internal leak, whose gap widens with pressure, took 49,560 of chi2, and a relief valve that the
    maps would have hidden took 291 beside it.
    """
    return trial.gain < ALIKE**2 * clearest_gain(state.found)


def clearest_gain(effects: Iterable[AcceptedEffect]) -> float:
    """chi2 that the clearest effect found has taken; 0 without any."""
    return max((effect.gain for effect in effects), default=0.0)


def is_noticed(present: Fit, trial: Trial) -> bool:
    """True for an immaterial cause that explains a fair part of the misfit all the same.

    trial: as it ended.  On a sweep derivatives promised a line 340 of chi2, and beside it the
    record was 49 less likely: kept, it hid a leak that nothing confirms.
    """
    dof = present.regression.dof
    return trial.gain > max(NOTICED * dof, LEAST_SHARE * (present.held.sse - dof))


def explains_enough(state: TrialState, present: Fit, trial: Trial) -> bool:
    """False where a cause is a small part of what is left behind an effect of the wrong form.

    Once most of the first misfit is explained, the rest of a form that is nearly right would be
    named as effects of their own.
    """
    rest = present.held.sse - present.regression.dof
    excess = state.excess
    if present.rho < MATCH_RHO or excess <= 0:
        return True
    return trial.gain > (SHARE if rest < (1 - NAMED) * excess else LEAST_SHARE) * rest
