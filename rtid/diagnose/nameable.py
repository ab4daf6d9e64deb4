"""From which size on an effect would have been named: what a reader takes a limit for.

Leaving out an effect of size c leaves c r of the flows and moves maps and moduli by c b, where

    z = X b + r,    z its column for a size of 1,  X those of maps, compliances and other effects,

so all that a name needs (`diagnosis`) is linear in c: to be significant, and that c r is material,
or that c z is, or what c b moves.  r is that of the motion that taught the maps: where unseen
motion shows more, a smaller effect is named as well (one of a tenth was).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from rtid.diagnose.bank import add_shapes, add_timing, offer
from rtid.diagnose.commands import commands
from rtid.diagnose.consequence import ALIKE, BEND, BENT, HIDDEN_GAIN, OWN, SOFTER
from rtid.diagnose.evidence import AT_ONCE, Rows, project
from rtid.diagnose.excuse import counted
from rtid.diagnose.regression import LIMIT_SD, Score
from rtid.diagnose.residual import KNOWN
from rtid.diagnose.verdict import MATERIAL
from rtid.effects.column import Candidate, Columns
from rtid.effects.law import Volumes, chambers_by_place
from rtid.effects.laws.timing import COMMAND
from rtid.kernels.explain import filter_rows
from rtid.plain import BoolArray, FloatArray, Key
from rtid.units import Z95

if TYPE_CHECKING:
    from rtid.diagnose.fit import Fit

NOTHING = 1e-300
STORAGE = "storage"  # kind of effects that trade with a modulus
VISIBLE = 2e-3  # share of a column that must be left beside the maps


@dataclass(frozen=True)
class Reach:
    """What leaving out one unit of a column does; sd: of its size.

    left: of the rms flow, what nothing else follows; own: its own flow, inf for a timing; bend: of
    a map's largest flow, the most of all; softer: of a modulus, where its interval is the narrower;
    gain: chi2 that it must take to be named where only the maps show it; moved: of that modulus,
    whatever its interval.
    """

    sd: float
    left: float
    own: float
    bend: float
    softer: float
    gain: float = HIDDEN_GAIN
    moved: float = 0.0

    @property
    def named_from(self) -> float:
        """The size from which on it is named: the residual shows it, or the maps hide it."""
        shown = MATERIAL / max(min(self.left, BENT * self.own), NOTHING)
        hidden = max(float(np.sqrt(self.gain)) * self.sd, self.matters_from)
        return max(LIMIT_SD * self.sd, min(shown, hidden))

    @property
    def matters_from(self) -> float:
        """The size from which on its own flow, a map or a modulus is wrong without it."""
        own = self.own if np.isfinite(self.own) else 0.0
        return 1.0 / max(own / OWN, self.bend / BEND, self.softer / SOFTER, NOTHING)

    def beyond_interval(self, size: float) -> float | None:
        """By how much, relative, a size moves a modulus; None where its interval holds that."""
        return abs(size) * self.moved if abs(size) * self.softer >= SOFTER else None

    def not_believed(self, score: Score) -> float:
        """The size that a record shows and that matters, but which nothing confirms; else 0.

        What the maps' polynomials miss looks like an effect, of either sign; what the pressures'
        noise feigns is out of it (`attenuation`).  So no smaller one would have been seen: none
        within what its interval holds, whose upper end this is.
        """
        size = abs(score.value)
        if not size > max(LIMIT_SD * self.sd, self.matters_from):
            return 0.0
        return size + Z95 * self.sd


def clearest(scores: list[tuple[Candidate, Score]]) -> dict[Key, tuple[Candidate, Score]]:
    """The column of each cause whose size the record tells best.

    Of a timing, the one as strong as its own limit, of those that the record shows: a column is
    made for one strength, and a share of 0.01 of one for 60 ms is no delay of 0.6 ms.  Of a cause
    whose form may be nothing, the one without: of a volume that is 4 ms late a quarter is seen of
    one that is not late.  Of what differs by numbers that the limit is not told with, as the
    exponent of air, the one whose size is told worst: 0.025 of air of exponent 1.4 was the limit
    where 0.030 of 1.3 was passed over, which is as soft as 0.053 of 1.0.
    """
    best: dict[Key, tuple[Candidate, Score]] = {}
    for candidate, score in _worst_of_untold(scores):
        known = best.get(candidate.key)
        if known is None or _rank(candidate, score) < _rank(*known):
            best[candidate.key] = candidate, score
    return best


def _worst_of_untold(
    scores: list[tuple[Candidate, Score]],
) -> list[tuple[Candidate, Score]]:
    """Of columns that differ by numbers without a unit alone, the one whose size is told worst."""
    worst: dict[Candidate, tuple[Candidate, Score]] = {}
    for candidate, score in scores:
        told = candidate
        if candidate.where != COMMAND and not candidate.is_whole:
            told = replace(candidate, shape=tuple(value for _, value, _ in told_form(candidate)))
        known = worst.get(told)
        if known is None or score.sd > known[1].sd:
            worst[told] = candidate, score
    return list(worst.values())


def told_form(candidate: Candidate) -> list[tuple[str, float, str]]:
    """Name, value and unit of the numbers of its form that a limit is told with: they have one."""
    numbers = zip(candidate.shape_names, candidate.shape, candidate.shape_units, strict=True)
    return [(name, value, unit) for name, value, unit in numbers if unit != "1"]


def known_as_moduli(
    fit: Fit, scores: list[tuple[Candidate, Score]]
) -> list[tuple[Candidate, Score]]:
    """The scores, of what is stored no better known than the modulus that it trades with.

    What the blocks miss looks like compressed oil: air was seen from 0.1 % on beside a modulus that
    was known to 50 times itself.
    """
    if not fit.declared.has_pressures:
        return scores
    ratio = counted(fit).diagonal() / np.maximum(fit.compliance_cov.diagonal(), NOTHING)
    wider = np.sqrt(np.maximum(1.0, ratio))
    places = chambers_by_place(fit.declared).items()
    known = {(STORAGE, where): float(np.max(wider[list(at)])) for where, at in places}
    times = [known.get((candidate.law.kind, candidate.where), 1.0) for candidate, _ in scores]
    return [(c, replace(s, sd=by * s.sd)) for by, (c, s) in zip(times, scores, strict=True)]


def _rank(candidate: Candidate, score: Score) -> tuple[bool, float]:
    """The less, the rather its column tells the limit of a cause."""
    if candidate.where == COMMAND:
        return score.visible <= VISIBLE, off_its_own(LIMIT_SD * score.sd)
    return any(candidate.shape), score.sd


def off_its_own(share: float) -> float:
    """How far a share of a timing's column is from all of it, either way."""
    return abs(float(np.log(share))) if 0.0 < share < np.inf else np.inf


def reaches(
    fit: Fit, scores: list[tuple[Candidate, Score]], flow_m3s: float, clearest_gain: float = 0.0
) -> dict[Key, tuple[Candidate, Reach]]:
    """What each cause beside a fit does, by its clearest column; flow_m3s: rms of the flows.

    Of a timing, by the column as strong as what would be named.

    fit: with its rows and its bank; without them nothing is said.  clearest_gain: chi2 that its
    clearest effect took, of which what the maps would hide must take a hundredth.
    """
    if fit.rows is None or not fit.map.cells.size or not flow_m3s > 0.0:
        return {}
    wide = float(np.sqrt(max(1.0, fit.rho)))
    told = {candidate for candidate, _ in clearest(scores).values()}
    wanted = [
        (candidate, score.sd * wide)
        for candidate, score in scores
        if np.isfinite(score.sd) and (candidate.where == COMMAND or candidate in told)
    ]
    least = ALIKE**2 * clearest_gain
    known: dict[Key, tuple[Candidate, Reach]] = {}
    for candidate, by_rows in _reaches(fit, fit.rows, wanted, flow_m3s):
        reach = replace(by_rows, gain=max(HIDDEN_GAIN * _numbers(candidate), least))
        other = known.get(candidate.key)
        if other is None or off_its_own(reach.named_from) < off_its_own(other[1].named_from):
            known[candidate.key] = candidate, reach
    return known


def _numbers(candidate: Candidate) -> int:
    """Those that describe it; the column of a timing is the whole of one."""
    return len(candidate.shape) if candidate.where == COMMAND else candidate.n_parameters


def _reaches(
    fit: Fit, rows: Rows, wanted: list[tuple[Candidate, float]], flow_m3s: float
) -> list[tuple[Candidate, Reach]]:
    """What leaving out each wanted candidate does; with them the deviations of their sizes."""
    gathering = _Gathering(fit, rows, flow_m3s, dict(wanted))
    columns = Columns(gathering.take)
    add_timing(fit.view, columns, commands(fit.declared, fit.chunk), fit.weights, fit.revision)
    list(add_shapes(fit.view, columns, fit.revision))
    offer(fit.view, columns, fit.revision, True, (), fit.suspects, gathering.wants)
    return gathering.ended()


class _Gathering:
    """Takes the columns of a bank as they come, and tells of a few at a time.

    wanted: deviation of the size of each candidate, of which the first column counts.
    """

    def __init__(
        self, fit: Fit, rows: Rows, flow_m3s: float, wanted: dict[Candidate, float]
    ) -> None:
        self._fit, self._rows, self._flow_m3s, self._wanted = fit, rows, flow_m3s, wanted
        self._on_rows, self._narrow = _OnRows.of(fit, rows), _narrowness(fit)
        self._relative = _relative(fit)
        self._used = {k - fit.first_given for k in fit.estimate.used}
        self._n, self._beside = 0, list[Volumes]()
        self._next: tuple[Candidate, float] | None = None
        self._asked = list[tuple[Candidate, float, Volumes]]()
        self._told = list[tuple[Candidate, Reach]]()

    def wants(self, candidate: Candidate) -> bool:
        """True for one that is to be told of; its column comes next, if it has any."""
        is_wanted = candidate in self._wanted
        self._next = (candidate, self._wanted.pop(candidate)) if is_wanted else None
        return is_wanted

    def take(self, volumes: Volumes, is_aside: bool) -> None:
        """The next column; those in use come before those that are wanted, which stand aside."""
        if self._next and is_aside:
            self._asked.append((*self._next, self._rows.on_rows(volumes)))
        elif self._n in self._used:
            self._beside.append(self._rows.on_rows(volumes))
        self._n += 1
        if len(self._asked) == AT_ONCE:
            self._tell()

    def ended(self) -> list[tuple[Candidate, Reach]]:
        """What was told, all columns having come."""
        if self._asked:
            self._tell()
        return self._told

    def _tell(self) -> None:
        used, n = list(self._fit.estimate.used), self._fit.first_given + len(self._beside)
        given = [*self._beside, *(volumes for _, _, volumes in self._asked)]
        projected, whole = project(self._rows, given), self._rows.columns(given)
        gram = projected.schur[1:n, 1:n] + np.diag(self._fit.regression.prior[used] + NOTHING)
        shares = np.asarray(np.linalg.solve(gram, projected.schur[1:n, n:]).T, np.float64)
        terms = projected.terms(list(range(1, n)), shares, slice(n, None))
        for k, (candidate, sd, _) in enumerate(self._asked):
            follows = whole[:, :, 1:n] @ shares[k]
            reach = self._reach(candidate, sd, whole[:, :, n + k], follows, (shares[k], terms[k]))
            self._told.append((candidate, reach))
        self._asked = []

    def _reach(
        self,
        candidate: Candidate,
        sd: float,
        z: FloatArray,
        follows: FloatArray,
        b: tuple[FloatArray, FloatArray],
    ) -> Reach:
        """Of z (rows, chambers), m3; follows: the part that the columns in use take of it.

        b: their shares in it, and the terms of the maps that take theirs.
        """
        on_rows, (shares, terms) = self._on_rows, b
        flows = on_rows.flows(terms)
        left = on_rows.rms(z - follows - on_rows.into_chambers(flows)) / self._flow_m3s
        moves = np.abs(shares[: len(self._narrow)])
        softer, moved = (np.max(moves * by, initial=0.0) for by in (self._narrow, self._relative))
        own = np.inf if candidate.where == COMMAND else on_rows.rms(z) / self._flow_m3s
        return Reach(sd, left, own, on_rows.bend(flows), float(softer), moved=float(moved))


def _narrowness(fit: Fit) -> FloatArray:
    """Relative move of each modulus per unit (chambers,), less where its interval is the wider.

    It is the one that is told, as of a consequence: by the noise's alone a delay of 2.5 ms would
    have been named on a sweep, where one of 6 ms moved a modulus by half of what is known of it.
    """
    half = Z95 * np.sqrt(np.maximum(np.diag(counted(fit)), 0.0))
    wide = half / np.maximum(np.abs(fit.compliance), NOTHING) / SOFTER
    return np.asarray(_relative(fit) / np.maximum(1.0, wide))


def _relative(fit: Fit) -> FloatArray:
    """Relative move of each modulus per unit (chambers,)."""
    return np.asarray(fit.weights.compliance / np.maximum(np.abs(fit.compliance), NOTHING))


@dataclass(frozen=True)
class _OnRows:
    """The rows of a fit as flows.

    t_s (rows + 1,): their borders; row, edge (entries,): of what blocks add; largest (edges,):
    flows by the fit's map, m3/s; known (rows,): where the map is known well.
    """

    fit: Fit
    rows: Rows
    t_s: FloatArray
    row: np.ndarray
    edge: np.ndarray
    known: BoolArray

    @classmethod
    def of(cls, fit: Fit, rows: Rows) -> _OnRows:
        """As flows; the time of a row is that of its intervals."""
        edges = fit.model.maps
        sizes = [e.grid.shape[0] * e.grid.shape[1] for e in edges]
        edge = np.repeat(np.arange(len(edges)), sizes)[rows.cells[rows.block]]
        row = np.repeat(np.arange(len(rows.start) - 1), np.diff(rows.start))
        lasts = np.maximum(rows.condensed(fit.view.dt_s), fit.view.step_s)
        t_s = np.concatenate([[0.0], np.cumsum(lasts)])
        known = np.ones(len(lasts), bool)
        if len(fit.map.cov):
            inner = np.einsum("ej,ejk->ek", rows.terms, fit.map.cov[rows.block])
            sd = np.sqrt(np.maximum(np.einsum("ek,ek->e", inner, rows.terms), 0.0)) / lasts[row]
            rated = np.array([e.rated_q_m3s for e in edges])[edge]
            known[row[sd > KNOWN * fit.model.gates.max_sd_share * rated]] = False
        return cls(fit, rows, t_s, row, edge, known)

    def flows(self, terms: FloatArray) -> FloatArray:
        """Volumes (entries,), m3, that maps with terms (V, 6) let into what their edges feed."""
        return np.asarray(np.einsum("ej,ej->e", self.rows.terms, terms[self.rows.block]))

    def into_chambers(self, volumes: FloatArray) -> FloatArray:
        """Those of (entries,) into the chambers (rows, chambers), m3."""
        sign, n = self.rows.sign[self.rows.block], len(self.known)
        n_c = len(self.fit.model.chambers)
        return np.stack(
            [np.bincount(self.row, sign[:, c] * volumes, n) for c in range(n_c)], axis=1
        )

    def rms(self, volumes: FloatArray) -> float:
        """Root mean square of volumes (rows, chambers), m3, as flows behind H_f, m3/s."""
        rates = volumes / np.diff(self.t_s)[:, None]
        rates[~self.known] = np.nan
        by = self.fit.model.filter
        period = 1.0 / by.rows_per_s
        out = np.empty((int(self.t_s[-1] / period) + 2, 1 + rates.shape[1]))
        n = filter_rows(self.t_s, rates, by.wn_rad_s, by.zeta, period, out)
        return float(np.sqrt(np.mean(out[:n, 1:] ** 2))) if n else 0.0

    def bend(self, volumes: FloatArray) -> float:
        """Root mean square of each edge's volumes (entries,), of its largest flow: the most."""
        most = 0.0
        usual = self._of_edges(self.flows(self.fit.map.terms))
        for flow, own in zip(self._of_edges(volumes), usual, strict=True):
            open_ = self.known & (own != 0.0)
            if open_.any():
                largest = max(float(np.abs(own[open_]).max()), NOTHING)
                most = max(most, float(np.sqrt(np.mean(flow[open_] ** 2))) / largest)
        return most

    def _of_edges(self, volumes: FloatArray) -> FloatArray:
        """Flows (edges, rows), m3/s, of volumes (entries,)."""
        n, edges = len(self.known), len(self.fit.model.maps)
        total = np.bincount(self.edge * n + self.row, volumes, n * edges).reshape(edges, n)
        return np.asarray(total / np.diff(self.t_s))
