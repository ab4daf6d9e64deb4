"""Methods that choose among columns, and so can name what is missing: PySINDy twice, and stepwise.

    SINDy              all at once: dP/dt on the map's terms and the suspects', over V (STLSQ)
    SINDy discrepancy  what the fitted map leaves of dP/dt on the suspects alone (STLSQ)
    stepwise           suspects added one by one to the least squares map, while the part of the
                       record that is held out gains

All columns pass the same filter as the pressure rate, and are scaled to unit rms, so that a
threshold is a share of what the pressure does.  It is chosen on the last quarter of the record
that teaches, the smallest model within 2 % of the best.  PySINDy (MIT).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import pysindy

from benchmarks.missing.front import Front
from benchmarks.missing.linear import LinearMap, fitted, map_columns, solved
from benchmarks.missing.methods.least_squares import bases
from benchmarks.missing.record import Learned, Names, Record
from benchmarks.missing.suspects import Library
from rtid.plain import BoolArray, FloatArray

THRESHOLDS = np.geomspace(1e-3, 0.3, 9)
HELD_OUT, WITHIN, MOST = 0.25, 1.05, 3
SOFTEST = 1e-10  # 1/Pa: a size that makes the oil stiffer than steel is no size
WORTH = 0.98  # of the held-out error, that a suspect must bring it to


@dataclass(frozen=True)
class Problem:
    """Both chambers' rows under each other: y (n,) and columns (n, k) in m3/s.

    names: of the suspects, whose columns stand behind those of the map and the moduli, n_map.
    """

    library: Library
    y: FloatArray
    columns: FloatArray
    names: tuple[frozenset[str], ...]
    n_map: int


def problem(front: Front, linear: LinearMap) -> Problem:
    """s A v on compressibility, map and suspects."""
    moved, stored = front.balance()
    blocks = []
    for c in range(2):
        blocks.append(np.hstack([-stored[:, c : c + 1], *map_columns(front, c, linear.basis)]))
    first = np.vstack([np.hstack([blocks[0], np.zeros_like(blocks[1])]),
                       np.hstack([np.zeros_like(blocks[0]), blocks[1]])])  # fmt: skip
    names, extra = [], []
    library = Library.of(front, linear)
    for suspect in library.suspects(front):
        names.append(suspect.names)
        extra.append(front.filtered(suspect.column).T.ravel())
    columns = np.column_stack([first, *extra])
    return Problem(library, moved.T.ravel(), columns, tuple(names), first.shape[1])


def taught(count: int) -> BoolArray:
    """Rows (2 count,) that teach: the first three quarters of both chambers."""
    return np.tile(np.arange(count) < (1.0 - HELD_OUT) * count, 2)


@dataclass(frozen=True)
class Extended:
    """A linear map and suspects with their sizes."""

    linear: LinearMap
    library: Library
    chosen: dict[int, float]

    def predict(self, record: Record) -> FloatArray:
        """dP/dt (n, c), Pa/s; what is stored stands beside V / beta."""
        front = Front(record)
        at, suspects = front.samples, self.library.suspects(front)
        flow, soft = at.into(self.linear.flows(at)) - at.moved, at.volume / self.linear.beta_pa
        for k, size in self.chosen.items():
            softness = suspects[k].softness
            if softness is None:
                flow = flow + size * suspects[k].column
            else:
                soft = soft + size * softness
        return np.asarray(flow / np.maximum(soft, SOFTEST * at.volume))

    def learned(self, names: tuple[frozenset[str], ...]) -> Learned:
        """All of it as an answer: suspects of one name are one effect."""
        missing: Names = tuple(dict.fromkeys(names[k] for k in self.chosen))
        m = self.linear
        return Learned(self.predict, m.flow, m.sd, m.beta_pa, m.beta_sd_pa, missing)


def refitted(front: Front, linear: LinearMap, p: Problem, chosen: list[int]) -> Extended:
    """Map, moduli and chosen suspects once more, all together on the whole record."""
    used = [*range(p.n_map), *(p.n_map + k for k in chosen)]
    answer = solved(p.columns[:, used], p.y)
    sizes = dict(zip(chosen, answer.theta[p.n_map :], strict=True))
    theta, cov, first = list(linear.theta), list(linear.cov), 0
    beta, sd = np.empty(2), np.empty(2)
    low, high = front.samples.machine.beta_bounds_pa
    for c in range(2):
        beta[c] = 1.0 / np.clip(answer.theta[first], 1.0 / high, 1.0 / low)
        sd[c] = beta[c] ** 2 * np.sqrt(answer.cov[first, first])
        first += 1
        for e in front.samples.edges_of(c):
            k = slice(first, first + len(theta[e]))
            theta[e], cov[e], first = answer.theta[k], answer.cov[k, k], k.stop
    names = linear.machine_edges
    return Extended(
        LinearMap(names, linear.basis, tuple(theta), tuple(cov), beta, sd), p.library, sizes
    )


def sindy(columns: FloatArray, y: FloatArray, threshold: float) -> FloatArray:
    """Coefficients (k,) of the columns that survive, scaled to unit rms (0: constant zero)."""
    size, unit = np.sqrt(np.mean(columns**2, axis=0)), np.sqrt(np.mean(y**2))
    scaled = columns / np.maximum(size, 1e-300)
    library = pysindy.PolynomialLibrary(degree=1, include_bias=False)
    optimizer = pysindy.STLSQ(threshold=threshold, alpha=1e-6, max_iter=30)
    model = pysindy.SINDy(optimizer=optimizer, feature_library=library)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        still = np.zeros((len(y), 1))  # the state itself is no term: its columns are given
        model.fit(still, t=1.0, x_dot=(y / unit)[:, None], u=scaled)
    found = np.asarray(model.coefficients())[0, 1:]
    return np.asarray(found * unit / np.maximum(size, 1e-300))


def chosen_by_sindy(columns: FloatArray, y: FloatArray, first: int) -> list[int]:
    """Suspects (columns from `first` on) that survive the best threshold on held-out rows."""
    rows = taught(len(y) // 2)
    trials = []
    for threshold in THRESHOLDS:
        theta = sindy(columns[rows], y[rows], float(threshold))
        error = float(np.mean((y[~rows] - columns[~rows] @ theta) ** 2))
        trials.append((error, np.flatnonzero(theta[first:])))
    best = min(error for error, _ in trials)
    good = [survived for error, survived in trials if error <= WITHIN**2 * best]
    return [int(k) for k in min(good, key=len)]


class Sindy:
    """PySINDy on all columns, or on what the map leaves."""

    says_names = True

    def __init__(self, name: str, discrepancy: bool) -> None:
        self._name, self._discrepancy = name, discrepancy

    def name(self) -> str:
        """Its row."""
        return self._name

    def learn(self, train: Record) -> Learned:
        """Survivors, and a last fit of everything beside them."""
        front = Front(train)
        linear = fitted(front, bases(front.samples))
        p = problem(front, linear)
        columns, y, first = p.columns, p.y, p.n_map
        if self._discrepancy:
            y = solved(columns[:, :first], y).left
            columns, first = columns[:, first:], 0
        chosen = chosen_by_sindy(columns, y, first)
        return refitted(front, linear, p, chosen).learned(p.names)


class Stepwise:
    """Least squares, and the suspect that helps most on held-out rows, up to three times."""

    says_names = True

    def name(self) -> str:
        """Its row."""
        return "stepwise least squares"

    def learn(self, train: Record) -> Learned:
        """The map with what was chosen."""
        front = Front(train)
        linear = fitted(front, bases(front.samples))
        p = problem(front, linear)
        rows, chosen = taught(len(p.y) // 2), list[int]()
        error = self._error(p, rows, chosen)
        while len(chosen) < MOST:
            trials = {k: self._error(p, rows, [*chosen, k]) for k in range(len(p.names))}
            best = min(trials, key=lambda k: trials[k])
            if trials[best] > WORTH * error:
                break
            chosen.append(best)
            error = trials[best]
        return refitted(front, linear, p, chosen).learned(p.names)

    def _error(self, p: Problem, rows: BoolArray, chosen: list[int]) -> float:
        used = [*range(p.n_map), *(p.n_map + k for k in chosen)]
        theta = solved(p.columns[np.ix_(rows, used)], p.y[rows]).theta
        return float(np.sqrt(np.mean((p.y[~rows] - p.columns[~rows][:, used] @ theta) ** 2)))


METHODS = (
    Sindy("PySINDy", discrepancy=False),
    Sindy("PySINDy, discrepancy", discrepancy=True),
    Stepwise(),
)
