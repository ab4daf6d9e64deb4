"""Forgetting that loses no more than it gains.

An exponential window would let everything fade that is not excited.  Here an unknown fades as if it
had walked at random (Kulhavy 1987; Cao and Schwartz 2000): with G the information of the past on a
group b of unknowns (a block, the shared ones), v_i the directions in which it and the information N
of the present are both diagonal, V' G_bb V = I, V' N V = diag(n_i),

    G <- G - G_:b V diag(loss) V' G_b:,    loss_i = min(1 - exp(-dt / T), n_i)

so that a direction without news keeps all it knows, the estimate itself stays where it is, other
blocks and the shared unknowns lose nothing, and G stays positive semidefinite.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import eigh

from rtid.estimator.sums import Normal, Sums
from rtid.kernels.layout import TERMS
from rtid.plain import FloatArray, IntArray

ALL = 1.0 - 1e-6  # the most that is lost at once: a positive diagonal stays positive
CHANGED = 0.99  # share that a block loses when its map is seen to hold no longer
PRIOR = 1e-9  # share of a term's own information, so that what is not excited can be solved for
TINY = 1e-12  # of the largest information of a group: directions below are left alone


def faded(past: Sums, news: Sums, share: float, shared: float, changed: IntArray) -> Sums:
    """The past as it enters the sum with the news.

    share and shared: 1 - exp(-dt / T) of the blocks and of the shared unknowns since the last
    time; changed (n,): grid cells whose map holds no longer.
    """
    normal, ns = past.normal(), past.n_shared
    gram, right, square = normal.gram, normal.right, normal.square
    fresh = dict(zip(news.cells.tolist(), news.blocks["gram"], strict=True))
    groups = [(np.arange(ns), _told_apart(news), shared)]
    for place, cell in enumerate(past.cells.tolist()):
        columns = ns + TERMS * place + np.arange(TERMS)
        if cell in changed:
            groups.append((columns, np.full((TERMS, TERMS), np.nan), CHANGED))
        elif cell in fresh:
            groups.append((columns, fresh[cell], share))
    before = gram[np.arange(ns), np.arange(ns)].copy()
    for columns, gained, most in groups:
        square -= _lose(gram, right, columns, gained, most)
    keep = np.divide(gram[np.arange(ns), np.arange(ns)], before, where=before > 0, out=before * 0)
    noise = normal.noise * keep[: len(normal.noise)]
    return past.with_normal(Normal(gram, right, square, noise, normal.rows))


def _told_apart(news: Sums) -> FloatArray:
    """What the news say about the shared unknowns beside the maps and beyond pressure noise."""
    normal, ns, n_c = news.normal(), news.n_shared, len(news.noise)
    gram, cross = normal.gram[ns:, ns:], normal.gram[ns:, :ns]
    size = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    scaled = gram / np.outer(size, size) + PRIOR * np.eye(len(gram))
    cross = cross / size[:, None]
    rest = normal.gram[:ns, :ns] - cross.T @ np.linalg.solve(scaled, cross)
    at = np.arange(n_c)
    rest[at, at] = np.maximum(rest[at, at] - normal.noise, 0.0)
    return np.asarray(0.5 * (rest + rest.T))


def _lose(
    gram: FloatArray, right: FloatArray, place: IntArray, gained: FloatArray, most: float
) -> float:
    """Let one group of unknowns fade, gram and right in place; returns what y'y loses."""
    scale = np.sqrt(gram[place, place])
    used = scale > 0
    if not used.any() or most <= 0:
        return 0.0
    place, scale = place[used], scale[used]
    g = gram[np.ix_(place, place)] / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(g)
    kept = values > TINY * values[-1]
    whitening = vectors[:, kept] / np.sqrt(values[kept])  # W' g W = I
    if np.isnan(gained).any():
        turn, loss = whitening, np.full(whitening.shape[1], min(most, ALL))
    else:
        n = gained[np.ix_(used, used)] / np.outer(scale, scale)
        news, rotation = eigh(whitening.T @ n @ whitening)
        turn, loss = whitening @ rotation, np.clip(news, 0.0, min(most, ALL))
    v = turn / scale[:, None]
    columns, toward = gram[:, place] @ v, right[place] @ v
    gram -= (columns * loss) @ columns.T
    right -= (columns * loss) @ toward
    return float(loss @ toward**2)


def halved_surprise(past: Sums) -> Sums:
    """Let the blocks' record of surprises fade: what counts is how the map does now."""
    blocks = past.blocks.copy()
    for name in ("surprise", "judged"):
        blocks[name] *= 0.5
    return replace(past, blocks=blocks)


def without_surprise(news: Sums, changed: IntArray) -> Sums:
    """The news as knowledge: what surprised was the map given up in the cells changed (n,)."""
    blocks = news.blocks.copy()
    here = np.isin(news.cells, changed)
    for name in ("surprise", "judged"):
        blocks[name][here] = 0.0
    return replace(news, blocks=blocks)
