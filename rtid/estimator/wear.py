"""Slow wear: the gain of a whole map, or the size of a leak, that changes while it is learned.

Rows of a machine that wears contradict each other.  Least squares does not settle for their mean:
positions are known to some um, so that a gain off by 0.2 % costs a row hundreds of variances, and
each cell takes a part of it that depends on what was visited beside it, and when.  Such a map
foretells nothing, neither old nor new.  But a metering edge wears as a whole, Q -> (1 + g) Q, and g
is seen at once.  With what the past and the news know together, T, news (N, r) about the unknowns
theta, and a change s of the shared ones (compliances, sizes of leaks),

    B = [1_shared | theta of each edge's map],     e = r - N theta,
    (B' N B - B' N T^-1 N B) [s, g] = B' e - B' N T^-1 e,

where theta is free beside [s, g] to the part that the past does not know.  What was learned before
is then carried over as if it had been learned of the machine as it is now: the columns phi of a
map's terms become phi / (1 + g), and y gains its leaks' columns times s.  Nothing is forgotten by
it, and cells that the news have not visited follow.  The compliances are the oil's, and stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.estimator.factor import SHARED_PRIOR, factor_of, one_thread
from rtid.estimator.solution import Solution
from rtid.estimator.sums import Sums
from rtid.kernels.layout import TERMS
from rtid.model import Machine
from rtid.plain import FloatArray

GAIN_PRIOR = 1.0  # information on a gain: an edge without news has changed by 0 +- 1


@dataclass(frozen=True)
class Wear:
    """Relative change of the gain of each edge's map, and of the unknowns of the shared terms.

    gain (edges,); terms (terms,), in units of the terms' scales.
    """

    gain: FloatArray
    terms: FloatArray

    def times(self, share: float) -> Wear:
        """A share of it."""
        return Wear(share * self.gain, share * self.terms)


def wear_since(past: Sums, solution: Solution, total: Sums) -> tuple[Wear, Wear]:
    """What has changed behind `past`, whose solution it is, and its standard deviations.

    total: past and news.
    """
    model, news, ns = solution.model, total - past, total.n_shared
    theta = _placed(solution, total)
    columns = np.concatenate([np.eye(len(theta), ns), _of_edges(model, total, theta)], axis=1)
    seen, rest = news.times(columns), news.right - news.times(theta[:, None])[:, 0]
    n_c = len(news.noise)
    rest[:n_c] += (1 - solution.leverage) * news.noise * theta[:n_c]  # errors in variables
    with one_thread():
        factor = factor_of(total)
        solved = factor.solved(np.column_stack([seen, rest]))
    information = columns.T @ seen - seen.T @ solved[:, :-1]
    prior = np.repeat([SHARED_PRIOR, GAIN_PRIOR], [ns, len(model.edges)])
    information[np.diag_indices_from(information)] += prior
    cov = np.linalg.inv(information)
    change = cov @ (columns.T @ rest - seen.T @ solved[:, -1])
    sd = np.sqrt(max(1.0, solution.rho) * np.diag(cov))
    owners = ns + np.array(model.owners)
    return Wear(change[owners], change[n_c:ns]), Wear(sd[owners], sd[n_c:ns])


def _placed(solution: Solution, total: Sums) -> FloatArray:
    """The solution's unknowns in the order of the sums, zero where it has none."""
    ns = total.n_shared
    theta = np.zeros(ns + TERMS * len(total.blocks))
    theta[:ns] = solution.unknowns[:ns]
    places = {cell: k for k, cell in enumerate(total.cells.tolist())}
    at = [places[cell] for cell in solution.cells.tolist()]
    theta[ns:].reshape(-1, TERMS)[at] = solution.unknowns[ns:].reshape(-1, TERMS)
    return theta


def _of_edges(model: Machine, total: Sums, theta: FloatArray) -> FloatArray:
    """Columns (n, edges): the terms of one edge's map each."""
    columns = np.zeros((len(theta), len(model.edges)))
    owner = np.repeat(np.array(model.owners)[total.blocks["edge"]], TERMS)
    rows = total.n_shared + np.arange(len(owner))
    columns[rows, owner] = theta[rows]
    return columns


def carried_over(past: Sums, wear: Wear) -> Sums:
    """The past as if it had been learned of a machine that has changed so."""
    less = 1.0 / (1.0 + wear.gain[past.blocks["edge"]])
    blocks, shared = past.blocks.copy(), past.shared.copy()
    blocks["gram"] *= less[:, None, None] ** 2
    blocks["shared"] *= less[:, None, None]
    terms = slice(len(shared) - len(wear.terms), len(shared))
    blocks["shared"][:, :, 0] += blocks["shared"][:, :, terms] @ wear.terms
    shared[0] += wear.terms @ shared[terms]
    shared[:, 0] += shared[:, terms] @ wear.terms
    low, high = past.pairs.T
    tiles = past.tiles * (less[low] * less[high])[:, None, None]
    return replace(past, shared=shared, blocks=blocks, tiles=tiles)


def changed(solution: Solution, wear: Wear) -> Solution:
    """The solution of what was carried over, its unknowns alone."""
    unknowns, edges = solution.unknowns.copy(), [block.edge for block in solution.blocks]
    first = len(unknowns) - TERMS * len(edges)
    unknowns[first - len(wear.terms) : first] += wear.terms
    flows = unknowns[first:].reshape(-1, TERMS)
    flows *= 1.0 + wear.gain[edges, None]
    return replace(solution, unknowns=unknowns)
