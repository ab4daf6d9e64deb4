"""Whether a record tells two causes apart that both leave more than noise: by clusters of blocks.

A cause that leaves a misfit is at best nearly right, and so may another one be.  What they leave is
not independent from row to row: the same law misses the same flow at every visit of a block.  With
l_r = -2 ln likelihood of row r, its noise weighed as each of them weighs it,

    D = sum over the rows of l_r(other) - l_r(best),    var D = sum over the blocks of D_block^2

about the mean; the blocks of both chambers are crossed clusters (Vuong 1989, for the difference of
two laws neither of which need be true; `rtid.estimator.misfit` for the clusters).  On a sweep oil
that boiled below 1.7 MPa was named air, by 1,340 of chi2: 6.5 deviations if rows were independent,
2.4 by blocks.
"""

from __future__ import annotations

import numpy as np

from rtid.diagnose.bank import columns_of
from rtid.diagnose.commands import commands
from rtid.diagnose.evidence import Rows
from rtid.diagnose.fit import Fit
from rtid.effects.law import Volumes
from rtid.estimator.misfit import crossed
from rtid.kernels import products
from rtid.plain import FloatArray, IntArray

CLEARLY = 3.0  # standard deviations of the difference, by blocks


def is_told_apart(best: Fit, other: Fit, promise: float = 0.0) -> bool:
    """True where a record likes one fit of it clearly better than another one, by its blocks.

    Over the time of which both have rows: what has left the grids is none.  By their number alone a
    fit was told from itself less a row of 3,000, and one of rho 88 was better than one of 1.03.
    promise: of -2 ln likelihood, what the other one may still gain.
    """
    ours, theirs = best.own_rows, other.own_rows
    at, others = ours.weighed.paired(theirs.weighed)
    if not len(at):
        return False
    apart = loss(other, theirs)[others] - loss(best, ours)[at]
    total = float(apart.sum()) - promise
    about_mean = (apart - apart.mean())[:, None]
    blocks = [blocks_of(ours, c)[at] for c in range(ours.own.shape[1])]
    return total > CLEARLY * float(np.sqrt(crossed(about_mean, blocks)[0]))


def loss(fit: Fit, rows: Rows) -> FloatArray:
    """-2 ln likelihood of each row (rows,), dimensionless, but for a constant; rows: the fit's."""
    sent = commands(fit.declared, fit.chunk)
    given = list[Volumes]()
    columns, _, _ = columns_of(
        fit.view, lambda v, _: given.append(rows.on_rows(v)), sent, fit.weights, fit.revision
    )
    theta = dict(zip(fit.held.used, fit.held.theta, strict=True))
    at = {fit.column(e): fit.first + columns.candidates.index(e) for e in fit.revision.effects}
    by_column = rows.columns(given)
    left = by_column[:, :, 0].copy()
    for column, value in theta.items():
        left -= value * by_column[:, :, at.get(column, column)]
    left -= into_rows(rows, fit.map.terms)
    whitened = np.ascontiguousarray(left[:, :, None])
    products.whitened(whitened, rows.fresh, rows.whiten, rows.keep)
    factors = rows.whiten[:, : 2 * left.shape[1] : 2]
    return np.asarray((whitened[:, :, 0] ** 2 - 2.0 * np.log(factors)).sum(axis=1))


def into_rows(rows: Rows, terms: FloatArray) -> FloatArray:
    """What maps with terms (V, 6) add to the rows (rows, chambers), m3."""
    of_entries = np.einsum("ij,ij->i", rows.terms, terms[rows.block])
    row, n = _row_of_entries(rows), len(rows.own)
    signs = rows.sign[rows.block, : rows.own.shape[1]].T
    return np.stack([np.bincount(row, sign * of_entries, n) for sign in signs], axis=1)


def blocks_of(rows: Rows, chamber: int) -> IntArray:
    """The block of a chamber's edges that each row (rows,) ends in; a row without is one alone.

    Where valves are shut no terms miss anything: what tells a leak there is each row's own.
    """
    here, blocks = rows.sign[rows.block, chamber] != 0, len(rows.cells)
    block = blocks + np.arange(len(rows.own))
    block[_row_of_entries(rows)[here]] = rows.block[here]
    return block


def _row_of_entries(rows: Rows) -> IntArray:
    return np.repeat(np.arange(len(rows.own)), np.diff(rows.start))
