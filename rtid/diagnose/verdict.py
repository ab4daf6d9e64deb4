"""What a search amounts to: the model matches, something is missing, or nobody can tell."""

from __future__ import annotations

import numpy as np

from rtid.diagnose.clean import saturated
from rtid.diagnose.evidence import has_position
from rtid.diagnose.excuse import counted, rho_of_all
from rtid.diagnose.fit import Fit
from rtid.diagnose.residual import Residual
from rtid.diagnose.trials import TrialState
from rtid.effects.laws.timing import COMMAND
from rtid.estimator.coloured import noise_in
from rtid.estimator.validity import Doubt, doubts
from rtid.model import PROPORTIONAL, Machine

MATERIAL = 0.003  # of the rms flow: what an effect must change of the held-out residual
NAMED = 0.8  # of the misfit that effects must explain to be named where something else remains
NAMED_TIMING, CLEARLY_LEFT = 0.95, 2.0  # of it, where a command is late; rho that is no curve's
MOST_CUT = 0.5  # of the record, that may be lost to pressures at an end of their range
LEAST_ROWS = 50  # filtered rows that a part must have to be judged by
LEAST_EVIDENCE = 1000  # scalar rows of the record
ROWS_PER_UNKNOWN = 50
MOVES = 5.0  # times the sensors' floor that the measured flow of a part must reach to judge by it
FORETOLD = 2.0  # times the sensors' floor: more, and most of what is left there is no noise
LOW = 0.2  # cut-off of a logger's filter times the rows' interval, at most

MATCHES, MISSING, AMBIGUOUS = "matches", "missing", "ambiguous"
UNKNOWN, INSUFFICIENT = "unknown", "insufficient_data"


def can_judge(residual: Residual) -> bool:
    """True where the machine moves in a part, and its map is known over enough of it."""
    return len(residual.t_s) >= LEAST_ROWS and residual.flow_m3s > MOVES * residual.floor_m3s


def is_slight(residual: Residual) -> bool:
    """True where what is left beyond the sensors' noise is immaterial for the flow."""
    return is_immaterial(residual.rms_m3s, residual.floor_m3s, residual.flow_m3s)


def is_immaterial(left_m3s: float, floor_m3s: float, flow_m3s: float) -> bool:
    """The same of root mean squares: what is left, what the sensors leave, and the flow."""
    return float(np.sqrt(max(0.0, left_m3s**2 - floor_m3s**2))) < MATERIAL * flow_m3s


def is_foretold(left_m3s: float, floor_m3s: float, flow_m3s: float, map_sd_m3s: float) -> bool:
    """True where a model leaves little but noise of motion that it was not taught.

    What its maps themselves say that they may be off is no more than noise: of pressures of 0.06 %
    noise a healthy machine left 2.9 times the floor, and 1.05 times both.  One that matches what
    taught it, and no other motion, has had too little: three times the floor beside moduli that
    were 24 % soft, six times beside air and beside a leak that its maps had.
    """
    is_noise = left_m3s < FORETOLD * float(np.hypot(floor_m3s, map_sd_m3s))
    return is_noise or is_immaterial(left_m3s, floor_m3s, flow_m3s)


def foretells(after: Residual) -> bool:
    """The same of what a model leaves of a part."""
    return is_foretold(after.rms_m3s, after.floor_m3s, after.flow_m3s, after.map_sd_m3s)


def filtered_hz(fit: Fit) -> float:
    """Cut-off of the filter, Hz, behind which all chambers' pressures were logged; 0: none is seen.

    What is on lines between messages looks as if filtered from a quarter of the rows' rate on.
    """
    chunk, model = fit.chunk[has_position(fit.chunk)], fit.declared
    if len(chunk) < LEAST_ROWS or not model.has_pressures:
        return 0.0
    pressures = {end for edge in model.edges for end in (edge.source, edge.sink) if end}
    noises = {n: noise_in(chunk[:, 0], chunk[:, 2 + model.column(n)]) for n in pressures}
    cuts = [noise.filtered_hz for noise in noises.values() if noise.filtered_hz]
    if not cuts or not all(noises[c.pressure].is_filtered for c in model.chambers):
        return 0.0
    is_low = max(cuts) * float(np.median(np.diff(chunk[:, 0]))) < LOW
    return float(np.median(cuts)) if is_low else 0.0


def least_evidence(model: Machine) -> int:
    """Scalar rows that a record must have: fewer for maps that are straight, D w, in each block."""
    if any(edge.basis != PROPORTIONAL for edge in model.edges):
        return LEAST_EVIDENCE
    return min(LEAST_EVIDENCE, ROWS_PER_UNKNOWN * model.n_cells)


def doubts_about(fit: Fit) -> tuple[Doubt, ...]:
    """Compliances that are impossible, or contradict each other, by the noise and by rho."""
    return doubts(fit.declared, fit.compliance, fit.compliance_cov)


def told_doubts(fit: Fit) -> tuple[Doubt, ...]:
    """Those that stay where what the blocks miss is counted: no model that matches has them.

    It is what replay tells.  The sweep of a clean machine with compensated valves gave 1040 and
    1275 MPa to 3 and 6 %, where six terms per block know them to 70 and 550 %: an alarm.
    """
    if not doubts_about(fit):
        return ()
    return doubts(fit.declared, fit.compliance, counted(fit))


def verdict(
    state: TrialState,
    first: Fit,
    last: Fit,
    after: Residual,
    doubted: tuple[Doubt, ...],
    is_unseen: bool = True,
) -> str:
    """The verdict on a search from the first to the last fit, and what that leaves of a part.

    doubted: of the last fit, `told_doubts`; is_unseen: the part is not the one that taught the
    maps, which may have taken an effect in.
    """
    has_moved = last.regression.rows >= least_evidence(last.declared) and len(last.map.cells) > 0
    is_whole = float(np.mean(saturated(last.declared, last.chunk))) <= MOST_CUT
    if not (has_moved and is_whole and can_judge(after)):
        return INSUFFICIENT
    if not state.found:
        if state.judges_itself:
            return INSUFFICIENT
        # what was seen and is too small in a record that judges itself may matter on other motion,
        # and what is left there of its flow is less than its maps may have taken in
        is_open = bool(state.negligible) or is_slight(after)
        if not is_unseen and is_open and max(first.rho, rho_of_all(last)) >= last.most_rho:
            return INSUFFICIENT
        return _as_it_stands(last, after, doubted, is_unseen)
    # a rate without pressures is disturbed by whatever moves the machine: unseen data have judged
    doubtful = last.declared.has_pressures and last.rho >= last.most_rho
    # nor is a cause told that leaves a misfit and an oil that cannot be: hum was named a line
    is_impossible = any(doubt.is_invalid for doubt in doubted)
    if doubtful and (is_impossible or explained(state, last) < least_explained(last)):
        return INSUFFICIENT if state.judges_itself else UNKNOWN
    return AMBIGUOUS if any(f.alike for f in state.found[:1]) else MISSING


def least_explained(last: Fit) -> float:
    """Share of the misfit that what was found must explain where something else remains.

    What delays or lags a command has no form that may be a tenth off: a spool that may turn by 6/s
    at most was one of first order, and left 365 times the noise, an eighth of it.
    """
    is_late = any(timing.where == COMMAND for timing, _ in last.revision.timings)
    return NAMED_TIMING if is_late and last.rho > CLEARLY_LEFT else NAMED


def _as_it_stands(last: Fit, after: Residual, doubted: tuple[Doubt, ...], is_unseen: bool) -> str:
    """Of a model beside which nothing is named: a little may be what a logger's filter rounds off.

    And one that does not foretell what it has not seen matches what taught it alone.
    """
    if last.rho >= last.most_rho or doubted:
        is_veiled = is_slight(after) and not doubted and filtered_hz(last) > 0.0
        return INSUFFICIENT if is_veiled else UNKNOWN
    is_judged = is_unseen and last.declared.has_pressures
    return MATCHES if foretells(after) or not is_judged else INSUFFICIENT


def explained(state: TrialState, last: Fit) -> float:
    """Share of the misfit without any effect that a fit explains."""
    rest = last.held.sse - last.regression.dof
    return 1.0 - rest / state.excess if state.excess > 0 else 1.0
