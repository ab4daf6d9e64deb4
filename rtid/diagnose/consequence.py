"""What leaving an effect out does: to the published maps, to the moduli, and by its own flow.

A free map swallows what is nearly a function of (u, dp): a leak of a tenth of the flow may leave a
held-out residual at the sensors' floor, and a map that is as much wrong.  So an effect matters by
its consequence.  It is believed where it is *stable*: the sizes in two halves of the record agree,
and that from a grid of half the spacing agrees with them, within their joint 95 %, or a tenth.

    bend of a map = rms(Q_without - Q_with) / largest Q_with,  over the intervals of the record
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rtid.diagnose.commands import behind
from rtid.diagnose.evidence import rows_of
from rtid.diagnose.excuse import counted
from rtid.diagnose.fit import Fit, one_pass
from rtid.diagnose.halves import between_halves, in_its_form
from rtid.diagnose.lag_interval import known_lag
from rtid.diagnose.regression import LIMIT_SD
from rtid.diagnose.residual import is_known
from rtid.diagnose.trials import Trial
from rtid.effects.record_view import RecordView
from rtid.estimator.refine import halved_along, parents
from rtid.estimator.state import Weights
from rtid.kernels.layout import TERMS
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.units import Z95

OWN = 0.01  # of the rms flow: an effect's own flow from which it matters
BEND = 0.01  # of its largest flow: a map's move
SOFTER = 0.01  # of the modulus: its move, if beyond its 95 % interval without the effect
# of the size: within so much, two sizes agree whatever their intervals say, which do not know that
# a law is not quite the catalogue's.  The halves of a leak whose gap widens with pressure were 3 %
# apart, 3.8 of their joint standard deviations; without this it was not named at all
ALIKE = 0.1
# chi2 of what the maps have taken in, for each number that describes it: ten standard deviations.
# On a clean sweep the inertance of a line that was not there reached 56, stable, and moved a
# modulus by 3 %; for a dead volume on another a line took 115, three of its numbers at 4 to 5
HIDDEN_GAIN = 100.0
BENT = 3.0  # times its own flow that an effect may gain: it also bends the maps when it is missing


@dataclass(frozen=True)
class Consequence:
    """What leaving one effect out does.

    own_share: its own flow, of the rms flow, NaN for a timing; maps: edge and bend, of its largest
    flow; beta: chamber and relative move of its modulus, where that is beyond its 95 % interval;
    lag_s: move of the spools' lag, where a timing takes it beyond its own, 0 else.
    """

    own_share: float
    maps: tuple[tuple[str, float], ...]
    beta: tuple[tuple[str, float], ...]
    lag_s: float = 0.0

    @property
    def is_material(self) -> bool:
        """True where at least one of them matters."""
        bent = max((bend for _, bend in self.maps), default=0.0)
        softer = max((abs(move) for _, move in self.beta), default=0.0)
        return self.own_share >= OWN or bent >= BEND or softer >= SOFTER or self.lag_s != 0.0


def consequence(present: Fit, now: Fit, own_share: float) -> Consequence:
    """Of leaving out what `now` has and `present` has not; own_share: of its flow, inf if none.

    A modulus moves where it leaves the interval that is told without the effect, in which what the
    blocks miss is counted: on the clean sweep of a compensated machine that was 170 % wide, and
    6.6 %, beyond what the noise alone gives, made the position sensor 2.3 ms late.
    """
    softer = tuple(_softer(present, now, present.compliance_cov))
    if softer:
        softer = tuple(_softer(present, now, counted(present)))
    own = own_share if np.isfinite(own_share) else float("nan")
    return Consequence(own, tuple(_bends(present, now)), softer, _lag_moves(present, now))


def _lag_moves(present: Fit, now: Fit) -> float:
    """What one timing more takes of the spools' lag, s, beyond its interval; 0 where it stays.

    Of a delay of 20 ms that a lag had stood in for, 9.6 ms of 1.1, the maps bent by 0.01 %.
    """
    is_timing = len(now.revision.timings) > len(present.revision.timings)
    if not is_timing or now.revision.replaces_lag or not np.isfinite(present.lag_sd_s):
        return 0.0
    move = now.weights.lag_s - present.weights.lag_s
    is_clear = abs(move) > Z95 * present.lag_sd_s and abs(move) > Z95 * known_lag(present).sd_s
    return move if is_clear else 0.0


def _bends(present: Fit, now: Fit) -> Iterator[tuple[str, float]]:
    """Edge by edge, over the intervals in which it is open and both maps are known."""
    record = now.model, now.sent, now.weights
    with_it, without = (RecordView.of(*record, fit.map) for fit in (now, present))
    known = is_known(with_it) & is_known(without)
    for i, edge in enumerate(now.model.edges):
        flow, other = with_it.flow(i), without.flow(i)
        open_ = known & ((flow != 0.0) | (other != 0.0))
        if open_.any():
            largest = max(float(np.abs(flow[open_]).max()), 1e-300)
            yield edge.name, float(np.sqrt(np.mean((flow - other)[open_] ** 2))) / largest


def _softer(present: Fit, now: Fit, cov: FloatArray) -> Iterator[tuple[str, float]]:
    """Chamber and move of each modulus beyond its interval by a covariance (chambers, chambers)."""
    half = Z95 * np.sqrt(np.maximum(np.diag(cov), 0.0))
    moves = now.compliance - present.compliance
    for chamber, was, move, within in zip(
        now.model.chambers, present.compliance, moves, half, strict=True
    ):
        if abs(move) > within and was != 0.0:
            yield chamber.name, float(was / (was + move) - 1.0) if was + move else float("inf")


def is_stable(now: Fit, trial: Trial, is_needed: bool = False) -> bool:
    """True where the halves of the record, and a finer grid, give the size that all of it gives.

    Halves that could not tell the size from nothing confirm nothing; a finer grid is asked where
    it leaves the record's rows any freedom.  is_needed: without the effect the record does not
    match: then its halves may share one map.  Where it matches, each must tell by itself: what a
    map's polynomials miss is the same in both halves, and on a clean sweep a leak larger than the
    flow took 174 of chi2, with one size in either.  Where they cannot, a finer grid must: half the
    spacing leaves 1/8 to 1/64 of what polynomials miss, and all of a leak.  One of 2e-12 that bent
    a map by 1.9 % was 1.96e-12 +- 0.13e-12, and 2.18e-12 +- 0.18e-12 there.
    """
    column, value, sd = _size(now, trial)
    halves = between_halves(now, column) if is_needed else _of_either(now, trial)
    is_told = _has_one_size(value, *halves)
    if not is_told and (is_needed or not _has_one_size(value, *between_halves(now, column))):
        return False
    finer = on_finer(now)
    if finer is None:
        return is_told
    _, other, other_sd = _size(finer, trial)
    is_told = is_told or abs(other) > LIMIT_SD * other_sd
    return is_told and _is_alike(value, value - other, float(np.hypot(sd, other_sd)))


def _has_one_size(value: float, apart: float, sd: float) -> bool:
    """True for halves whose sizes are apart by nothing, and which tell them from nothing."""
    return Z95 * sd < abs(value) and _is_alike(value, apart, sd)


def _of_either(now: Fit, trial: Trial) -> tuple[float, float]:
    """Difference of the sizes in the halves of a record, each with maps of its own; deviation."""
    middle = len(now.chunk) // 2
    parts = now.chunk[:middle], now.chunk[middle:]
    (_, value, sd), (_, other, other_sd) = (
        _size(_again(now, now.declared, part, now.weights), trial) for part in parts
    )
    return value - other, float(np.hypot(sd, other_sd))


def on_finer(now: Fit) -> Fit | None:
    """The same revision on a grid of half the spacing; None where no freedom is left."""
    machine, weights = halved_along(halved_along(now.declared, 0), 1), now.weights
    of_whole = parents(now.declared, machine)
    weights = replace(weights, slopes=weights.slopes[of_whole], missed=weights.missed[of_whole])
    rows = rows_of(behind(machine, now.revision.timings), now.sent, weights)
    if rows.n <= TERMS * len(rows.cells):  # asked first: factors of 13,500 unknowns took 20 s
        return None
    return _again(now, machine, now.chunk, weights)


def _again(now: Fit, machine: Machine, chunk: FloatArray, weights: Weights) -> Fit:
    """The same revision on another grid or part, chunk (n, 2 + signals), SI; one pass is near."""
    return one_pass(machine, chunk, weights, now.revision, None, False, thorough=False)


def _size(fit: Fit, trial: Trial) -> tuple[int, float, float]:
    """The first free parameter of what was tried last: column, value, standard deviation.

    One at its bound is no size: a pump that only gives way at its limit has no droop.  That of a
    column is of its form as it stands, which is the same in every part and on every grid.
    """
    estimate = fit.estimate
    if trial.is_timing:
        k = len(fit.revision.timings) - 1
        timing, psi = fit.revision.timings[k]
        j = next((j for j in range(len(psi)) if timing.is_free(psi, j)), 0)
        column = fit.timing_columns(k)[j]
        value = psi[j] + fit.estimate.value(column)
    elif (effect := fit.revision.effects[-1]).is_whole and (free := fit.shape_columns(effect)):
        first = min(free)
        column = free[first]
        value = effect.shape[first] + fit.estimate.value(column)
    else:
        column, estimate = fit.column(effect), in_its_form(fit, effect)
        value = fit.held.value(column)
    return column, value, estimate.sd(column) * float(np.sqrt(max(1.0, fit.rho)))


def _is_alike(value: float, apart: float, sd: float) -> bool:
    """True for a difference of sizes that their deviation explains, or that is a tenth of them."""
    return abs(apart) <= max(Z95 * sd, ALIKE * abs(value))
