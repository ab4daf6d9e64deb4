"""A gain of all maps that walks at random: y = g(t) Q(u), g a random walk of q per second.

theta is the maps' as they are now.  Over an interval dt they become (1 + w) theta, w ~ N(0, q dt),
and the past, whose rows are Phi theta_before = Phi theta - w Phi theta, holds w as one unknown
more.  With d the maps' part of the estimate, and w taken out of G = Phi' Phi and r = Phi' y,

    G <- G - G d d' G / (1 / (q dt) + d' G d),        r <- r - G d d' r / (1 / (q dt) + d' G d),

which adds q dt d d' to the covariance of theta and changes nothing else: the estimate stays, and
the shape of the maps keeps all that it knows.  As in `forgetting`, no more is lost than news
replace: a machine that stands still forgets nothing.

A block at an end of its map in which the command did not move is a rest: a machine that stands on
its floor gives there what the floor does, and no gain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.estimator.blocks import conditions
from rtid.estimator.correction import plain
from rtid.estimator.factor import factor_of
from rtid.estimator.forgetting import ALL
from rtid.estimator.sums import Normal, Sums
from rtid.kernels.layout import TERMS
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Gain:
    """What one gain multiplies: terms (m, 6) of the blocks of the grid cells (m,), scaled units."""

    cells: IntArray
    terms: FloatArray

    def among(self, sums: Sums) -> FloatArray:
        """The same in the order of the unknowns of sums (n,), zero for all others, scaled units."""
        known = dict(zip(self.cells.tolist(), self.terms, strict=True))
        none = np.zeros(TERMS)
        terms = [known.get(cell, none) for cell in sums.cells.tolist()]
        return np.concatenate([np.zeros(sums.n_shared), *terms])


def gain_of(model: Machine, total: Sums) -> Gain:
    """What the gain multiplies by all that is known."""
    theta, _ = plain(total, factor_of(total))
    terms = theta[total.n_shared :].reshape(-1, TERMS)
    return Gain(total.cells, np.where(_rests(model, total)[:, None], 0.0, terms))


def walked(past: Sums, news: Sums, gain: Gain, variance: float) -> Sums:
    """The past as it enters the sum with the news; variance: of the gain's step between them."""
    if not (len(past.blocks) and len(news.blocks)):
        return past
    along, fresh = gain.among(past), gain.among(news)
    normal = past.normal()
    column = normal.gram @ along
    known, gained = float(along @ column), float(fresh @ news.times(fresh[:, None])[:, 0])
    if known <= 0.0:
        return past
    share = min(variance * known / (1.0 + variance * known), gained / known, ALL) / known
    toward = float(along @ normal.right)
    return past.with_normal(
        Normal(
            normal.gram - share * np.outer(column, column),
            normal.right - share * toward * column,
            normal.square - share * toward**2,
            normal.noise,
            normal.rows,
        )
    )


def _rests(model: Machine, total: Sums) -> BoolArray:
    """The blocks (m,) in which a command stands still at an end of its map."""
    condition = conditions(model, total.blocks)
    rests = condition > model.gates.condition_limit
    for k, record in enumerate(total.blocks):
        edge = model.edges[int(record["edge"])]
        i = (int(record["cell"]) - model.first_cells[int(record["edge"])]) // edge.grid.shape[1]
        rests[k] &= i in (0, edge.grid.shape[0] - 1)
    return np.asarray(rests)
