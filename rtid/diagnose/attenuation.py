"""What a record tells of a flow that the maps follow, the noise of the pressures taken out of it.

The column z of a flow and the terms of the maps are made of pressures p + n as they are measured.
With Q_b the maps that follow z, and Q those that follow y, what they leave of both has the noise

    n_z = (dz/dp - sum of dQ_b/dp) n,    n_y = - (sum of dQ/dp) n,

to first order in n, and the products S, s of all that is left are N = E[n n'] and N_y = E[n n_y]
more than they would be of pressures without noise.  So (Fuller, Measurement Error Models, 1987)

    (S - N) c = s - N_y,    cov c = (S - N)^-1 S (S - N)^-1.

Where a supply is constant nearly all that a sweep leaves of an external leak is the noise of the
supply's sensor: N / S was 0.7 to 1.0 on healthy machines that told one of 2.6e-11 +- 0.5e-11
m3/s/Pa, of nothing, and the products alone foretold 2.7e-11.  Of such a leak nothing is known.

What six terms miss scatters from block to block: a size is known no better than by the sum of
z_ r, r what is left beside it, in clusters of blocks (`rivals`), nor than a finer grid agrees.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rtid.diagnose.bank import columns_of
from rtid.diagnose.commands import commands
from rtid.diagnose.consequence import on_finer
from rtid.diagnose.evidence import Projected, Rows, project
from rtid.diagnose.fit import NO_COV, Fit, one_pass
from rtid.diagnose.nameable import VISIBLE, clearest
from rtid.diagnose.regression import FAINTEST, LIMIT_SD, Score
from rtid.diagnose.rivals import blocks_of, into_rows
from rtid.diagnose.sensor_noise import noise_of
from rtid.diagnose.trials import with_effect
from rtid.effects.column import Candidate
from rtid.effects.law import Volumes
from rtid.effects.laws import SEED, cause_of
from rtid.effects.laws.common import stored
from rtid.effects.laws.timing import COMMAND
from rtid.effects.record_view import MapTerms, RecordView
from rtid.estimator.misfit import crossed
from rtid.estimator.state import variance
from rtid.kernels import products
from rtid.plain import FloatArray, IntArray, Key

DRAWS = 4  # of the sensors' noise: N / S of 0.9 is known to 0.02 with 3,000 rows
FLOWS = ("flow", "map")  # kinds of effects whose columns the maps may follow
FAINT = (
    0.1  # of what the maps leave of a column, that must not be the sensors' noise to tell a size
)


@dataclass(frozen=True)
class Believed:
    """What a record tells of a size, in its unit.

    sd: by the rows' noise; sd_by_blocks: by how what is left scatters between blocks.  Both are
    inf, and the size 0, where what the maps leave of its column is the sensors' noise.
    """

    size: float
    sd: float
    sd_by_blocks: float


NOTHING_TOLD = Believed(0.0, float("inf"), float("inf"))


def apart_from_noise(
    fit: Fit, scores: list[tuple[Candidate, Score]]
) -> tuple[list[tuple[Candidate, Score]], frozenset[Key]]:
    """The scores of a fit with its rows; of flows that the maps follow, what a record really tells.

    Of those that hardly anything is left of, and of those that stand out: the clearest column of
    each, in the place of all others.  With the causes that do not stand out then.
    """
    if fit.rows is None or not fit.view.has_pressures:
        return scores, frozenset()
    wide = float(np.sqrt(max(1.0, fit.rho)))
    asked = {c.key: (c, s) for c, s in clearest(scores).values() if _is_doubtful(c, s, wide)}
    sizes = told_apart_from_noise(fit, fit.rows, [candidate for candidate, _ in asked.values()])
    finer = on_finer(fit) if any(_is_clear(known, wide) for known in sizes) else None
    better = [
        (candidate, _scored_again(score, _on_any_grid(fit, finer, candidate, known, wide), wide))
        for (candidate, score), known in zip(asked.values(), sizes, strict=True)
    ]
    nothing = frozenset(c.key for c, s in better if not s.gain > (LIMIT_SD * wide) ** 2)
    return [(c, s) for c, s in scores if c.key not in asked] + better, nothing


def stands_apart(fit: Fit, candidate: Candidate) -> bool:
    """Whether a record tells of a flow, or a line, that is not in a fit, the noise apart.

    True of other causes, and without pressures.  A line makes another noise of its pressure's: on
    a sweep whose modulus was 4 % too soft one of 8 mL took 1,139 of chi2, which the rows lost by
    being quieter; of its column 0.36 +- 0.19 were there apart from the noise.
    """
    is_asked = candidate.is_whole or _may_be_followed(candidate)
    if not is_asked or not fit.view.has_pressures:
        return True
    (known,) = told_apart_from_noise(fit, fit.own_rows, [candidate])
    return _is_clear(known, float(np.sqrt(max(1.0, fit.rho))))


def _is_clear(known: Believed, wide: float) -> bool:
    """Whether a size stands out of the rows' noise, so many times as wide, and of the blocks'."""
    return abs(known.size) > LIMIT_SD * max(wide * known.sd, known.sd_by_blocks)


def _may_be_followed(candidate: Candidate) -> bool:
    """Whether the maps may follow its flow."""
    return candidate.law.kind in FLOWS and candidate.where != COMMAND and not candidate.is_whole


def _is_doubtful(candidate: Candidate, score: Score, wide: float) -> bool:
    """True of a flow of which little is left, or that stands out; wide: times the noise."""
    if not _may_be_followed(candidate):
        return False
    stands_out = abs(score.value) > LIMIT_SD * wide * score.sd
    return bool(np.isfinite(score.sd)) and (score.visible <= VISIBLE or stands_out)


def _on_any_grid(
    fit: Fit, finer: Fit | None, candidate: Candidate, known: Believed, wide: float
) -> Believed:
    """What is told of a size that stands out, and how far that of a finer grid is from it.

    What six terms miss alike in every block scatters between none: on a sweep of overlapped spools
    an internal leak of 8.1e-13 was 4.5e-13 +- 0.8e-13, and 1.3e-13 on half the spacing.

    finer: the fit there, whose rows serve every candidate; None where no freedom is left.
    """
    if finer is None or not _is_clear(known, wide):
        return known
    (value, sd), (other, other_sd) = (_size_beside(on, candidate) for on in (fit, finer))
    more = max(0.0, other_sd**2 - sd**2)
    beyond = float(np.sqrt(max(0.0, (other - value) ** 2 - wide**2 * more)))
    return replace(known, sd_by_blocks=float(np.hypot(known.sd_by_blocks, beyond)))


def _size_beside(fit: Fit, candidate: Candidate) -> tuple[float, float]:
    """Size of a candidate beside what a fit has, on its rows, and its standard deviation."""
    beside = with_effect(fit, candidate)
    record = fit.declared, fit.chunk, fit.weights, beside, fit
    now = one_pass(*record, bank=False, thorough=False)
    column = now.column(candidate)
    return now.held.value(column), now.held.sd(column)


def _scored_again(score: Score, known: Believed, wide: float) -> Score:
    """A score with what is told of the size; its deviation is widened by the misfit later on."""
    sd = max(known.sd, known.sd_by_blocks / wide)
    gain = (known.size / sd) ** 2 if np.isfinite(sd) else 0.0
    return replace(score, value=known.size, sd=sd, gain=gain)


def told_apart_from_noise(fit: Fit, rows: Rows, asked: list[Candidate]) -> list[Believed]:
    """What a record tells of flows that are not in a fit of it; rows: the fit's."""
    if not asked:
        return []
    heads = _Heads.of(fit, rows, asked)
    return [heads.told(k) for k in range(len(asked))]


def sizes_apart_from_noise(fit: Fit, columns: list[int]) -> dict[int, Believed]:
    """What a record tells of sizes that are in a fit of it, by column."""
    heads = _Heads.of(fit, fit.own_rows, [])
    return {column: heads.told_of(column) for column in columns}


@dataclass(frozen=True)
class _Heads:
    """y, theta_beta, timings, shapes, effects, and columns that are asked for: h heads.

    given: how many come before those; whole (rows, chambers, h), m3; used: the fit's columns as
    heads; noise (h, h): of what the maps leave.
    """

    fit: Fit
    rows: Rows
    projected: Projected
    whole: FloatArray
    given: int
    used: list[int]
    noise: FloatArray

    @classmethod
    def of(cls, fit: Fit, rows: Rows, asked: list[Candidate]) -> _Heads:
        """Of a fit of these rows, and what is asked for beside it."""
        known = _known(fit, rows)
        columns = [*known, *(rows.on_rows(v) for v in _volumes(fit.view, asked))]
        given = fit.first_given + len(known)
        at = {fit.column(e): fit.first + k for k, e in enumerate(fit.revision.effects)}
        used = [at.get(column, column) for column in fit.estimate.used]
        projected = project(rows, columns)
        of_flows = [*fit.revision.effects, *asked]
        first = given - len(fit.revision.effects)
        noisy = [*range(fit.first_given), *range(first, given + len(asked))]
        noise = np.zeros((given + len(asked),) * 2)
        noise[np.ix_(noisy, noisy)] = _noise(fit, rows, projected, noisy, of_flows)
        return cls(fit, rows, projected, rows.columns(columns), given, used, noise)

    def told(self, k: int) -> Believed:
        """Of column k that is asked for."""
        return self._believed(self.used, self.given + k)

    def told_of(self, column: int) -> Believed:
        """Of a column of the fit."""
        at = self.used[self.fit.estimate.used.index(column)]
        return self._believed([head for head in self.used if head != at], at)

    def _believed(self, beside: list[int], head: int) -> Believed:
        """Of one head beside others."""
        at = [*beside, head]
        known = dict(zip(self.used, self._priors, strict=True))
        prior, mean = np.array([known.get(k, (0.0, 0.0)) for k in at]).T
        plain = self.projected.schur[np.ix_(at, at)] + np.diag(prior)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(plain), FAINTEST))
        clean = (plain - self.noise[np.ix_(at, at)]) * np.outer(scale, scale)
        if not _is_kept(plain * np.outer(scale, scale), clean):
            return NOTHING_TOLD
        inverse = np.linalg.inv(clean)
        right = self.projected.schur[at, 0] - self.noise[at, 0] + prior * mean
        theta = (inverse @ (right * scale)) * scale
        way = inverse[-1] * scale * scale[-1]  # what the size takes of each column's product
        sd = float(np.sqrt(way @ plain @ way))
        return Believed(float(theta[-1]), sd, self._by_blocks(at, theta, way))

    @property
    def _priors(self) -> list[tuple[float, float]]:
        """Information and mean that each column of the fit has beforehand."""
        known = self.fit.regression
        return [(known.prior[c], known.mean[c]) for c in self.fit.estimate.used]

    def _by_blocks(self, at: list[int], theta: FloatArray, way: FloatArray) -> float:
        """Standard deviation of a size that takes `way` of the columns, by what scatters."""
        moves = self._left(at, way) * self._left([0, *at], np.append(1.0, -theta))
        scores = moves.sum(axis=1)[:, None]
        return float(np.sqrt(crossed(scores - scores.mean(), self._clusters)[0]))

    @cached_property
    def _clusters(self) -> list[IntArray]:
        return [blocks_of(self.rows, c) for c in range(self.rows.own.shape[1])]

    def _left(self, at: list[int], theta: FloatArray) -> FloatArray:
        """What the maps leave of a sum of columns, whitened (rows, chambers)."""
        terms = self.projected.factor.whole(theta @ self.projected.half[at])
        rest = self.whole[:, :, at] @ theta - into_rows(self.rows, terms)
        whitened = np.ascontiguousarray(rest[:, :, None])
        products.whitened(whitened, self.rows.fresh, self.rows.whiten, self.rows.keep)
        return whitened[:, :, 0]


def _is_kept(plain: FloatArray, clean: FloatArray) -> bool:
    """Whether more than noise is left of the last of columns whose products are scaled (k, k).

    What the others do not follow of it: the pivot of its product, with the noise and without.
    """
    if np.linalg.eigvalsh(clean)[0] <= 0.0:
        return False
    with_noise, without = (1.0 / np.linalg.inv(of)[-1, -1] for of in (plain, clean))
    return bool(without > FAINT * with_noise)


def _known(fit: Fit, rows: Rows) -> list[Volumes]:
    """The columns of a fit behind those of the compliances, condensed."""
    given = list[Volumes]()
    sent = commands(fit.declared, fit.chunk)
    columns, n_timing, shapes = columns_of(
        fit.view, lambda v, _: given.append(rows.on_rows(v)), sent, fit.weights, fit.revision
    )
    return given[: n_timing + len(shapes) + len(columns.candidates)]


def _volumes(view: RecordView, candidates: list[Candidate]) -> Iterator[Volumes]:
    """Columns per interval of candidates, for a size of 1."""
    for candidate in candidates:
        yield cause_of(view, candidate).column(candidate.shape)


def _noise(
    fit: Fit, rows: Rows, projected: Projected, heads: list[int], effects: list[Candidate]
) -> FloatArray:
    """What the pressures' noise adds to the products of what the maps leave (k, k) of heads (k,).

    heads: y, theta_beta, and the columns of the effects.  The own noise of lags is left out.
    """
    terms = projected.factor.whole(projected.half[heads])
    along = [replace(fit.map, terms=by, cov=NO_COV) for by in terms]
    slopes = [_slopes(fit, by) for by in along]
    rng, columns = np.random.default_rng(SEED), list[Volumes]()
    plain = list(_volumes(fit.view, effects))
    for _ in range(DRAWS):
        noise = _drawn(fit.view, rng)
        own = _own(fit, noise, effects, plain)
        for head, by in zip(own, slopes, strict=True):
            columns.append(rows.on_rows(_beside_maps(fit.view, head, by, noise)))
    k, first = len(heads), fit.first_given
    found = project(rows, columns).schur[first:, first:]
    parts = [found[d * k : (d + 1) * k, d * k : (d + 1) * k] for d in range(DRAWS)]
    return np.asarray(np.mean(parts, axis=0))


def _slopes(fit: Fit, by: MapTerms) -> list[FloatArray]:
    """dQ/ddp of each edge (n - 1,), m3/s/Pa, along the record by other terms of its maps."""
    view = RecordView.of(fit.model, fit.sent, fit.weights, by)
    return [view.slope_dp(i) for i in range(len(fit.model.edges))]


def _drawn(view: RecordView, rng: np.random.Generator) -> dict[str, FloatArray]:
    """The noise of each measured pressure (n,), Pa."""
    model = view.model
    names = {c.pressure for c in model.chambers}
    names |= {name for e in model.edges for name in (e.source, e.sink)}
    noise = {}
    for name in sorted(names - {""}):
        if variance(model, name) > 0.0 and np.ptp(view.signal(name)) > 0.0:  # or it is nominal
            noise[name] = noise_of(view, name, rng)
    return noise


def _own(
    fit: Fit, noise: dict[str, FloatArray], effects: list[Candidate], plain: list[Volumes]
) -> Iterator[Volumes]:
    """The noise of the columns themselves: of y, theta_beta and effects, as plain as measured."""
    view, still = fit.view, np.zeros(fit.view.n)
    yield {}
    for c, chamber in enumerate(view.model.chambers):
        yield {c: view.compliance[c] * stored(view, c, noise.get(chamber.pressure, still))}
    chunk = view.chunk.copy()
    for name, values in noise.items():
        chunk[:, 2 + view.model.column(name)] += values
    bent = replace(view, chunk=chunk)
    for with_noise, without in zip(_volumes(bent, effects), plain, strict=True):
        yield {c: series - without[c] for c, series in with_noise.items()}


def _beside_maps(
    view: RecordView, head: Volumes, slopes: list[FloatArray], noise: dict[str, FloatArray]
) -> Volumes:
    """The noise of a column less that of the maps that follow it, per interval (n - 1,), m3."""
    still, flows = np.zeros(view.n), list[FloatArray]()
    for edge, slope in zip(view.model.edges, slopes, strict=True):
        dp = noise.get(edge.source, still) - noise.get(edge.sink, still)
        flows.append(0.5 * slope * (dp[1:] + dp[:-1]))
    out: Volumes = {}
    for c in range(len(view.model.chambers)):
        follows = view.into_chamber(c, flows) * view.dt_s
        out[c] = head.get(c, 0.0) - np.where(view.inside, follows, 0.0)
    return out
