"""Forgetting: no more is lost than gained, the estimate stays, the rest of the map too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.estimator.forgetting import CHANGED, _lose, faded
from rtid.estimator.state import build
from rtid.estimator.sums import Normal, Sums
from rtid.plain import FloatArray
from tests.estimator.cases import draw_case

NOTHING_CHANGED = np.zeros(0, np.int64)


def learned_parts() -> tuple[Sums, Sums]:
    case = draw_case(750, n=6000, blocks=9)
    state = build(case.model)
    state.advance(case.chunk[:5000])
    past = Sums.drained(state)
    state.advance(case.chunk[5000:5100])
    return past, Sums.drained(state)


def covariance(normal: Normal, ridge: FloatArray) -> FloatArray:
    """Covariance with a little prior, so that what is not excited stays finite."""
    return np.asarray(np.linalg.inv(normal.gram + np.diag(ridge)))


def test_information_shrinks_and_stays_definite() -> None:
    past, news = learned_parts()
    before, after = past.normal().gram, faded(past, news, 0.3, 0.2, NOTHING_CHANGED).normal().gram
    size = np.sqrt(np.maximum(np.diag(before), 1e-300))
    lost = np.linalg.eigvalsh((before - after) / np.outer(size, size))
    left = np.linalg.eigvalsh(after / np.outer(size, size))
    assert lost.min() > -1e-9 and lost.max() > 1e-3
    assert left.min() > -1e-9


def test_the_estimate_stays_where_it_is() -> None:
    past, news = learned_parts()
    theta = np.random.default_rng(1).standard_normal(len(past.normal().right))
    normal = past.normal()
    exact = past.with_normal(replace(normal, right=normal.gram @ theta))
    after = faded(exact, news, 0.5, 0.5, NOTHING_CHANGED).normal()
    size = np.sqrt(np.maximum(np.diag(normal.gram), 1e-300))
    np.testing.assert_allclose(
        (after.gram @ theta - after.right) / size,
        0.0,
        atol=1e-9 * np.abs(normal.right / size).max(),
    )


def test_blocks_without_news_and_shared_unknowns_keep_their_covariance() -> None:
    past, news = learned_parts()
    after = faded(past, news, 0.5, 0.0, NOTHING_CHANGED)
    ridge = 1e-9 * np.diag(past.normal().gram) + 1e-9
    old, new = (covariance(s.normal(), ridge) for s in (past, after))
    gained = dict(zip(news.cells.tolist(), news.blocks["gram"][:, 0, 0], strict=True))
    known = past.blocks["gram"][:, 0, 0]
    quiet = [k for k, c in enumerate(past.cells) if gained.get(int(c), 0.0) < 1e-8 * known[k]]
    at = np.concatenate([[0, 1], *(2 + 6 * k + np.arange(6) for k in quiet)]).astype(int)
    assert len(quiet) > 3
    sd = np.sqrt(np.diag(old)[at])
    # what hardly anything is known of feels rounding and the prior
    np.testing.assert_allclose((new - old)[np.ix_(at, at)] / np.outer(sd, sd), 0.0, atol=2e-3)


def test_no_direction_of_a_group_loses_more_than_it_gains() -> None:
    """Given all other unknowns; these lose what they must not pretend to know with the group."""
    past, news = learned_parts()
    for record in news.blocks[:10]:
        normal = past.normal()
        place = int(np.flatnonzero(past.cells == record["cell"])[0])
        own = 2 + 6 * place + np.arange(6)
        before = normal.gram[np.ix_(own, own)].copy()
        _lose(normal.gram, normal.right, own, record["gram"], 1.0)
        now = normal.gram[np.ix_(own, own)] + record["gram"]
        size = np.sqrt(np.diag(before)) + 1e-30
        gained = np.linalg.eigvalsh((now - before) / np.outer(size, size))
        assert gained.min() > -1e-9


def test_a_changed_block_gives_up_nearly_all() -> None:
    past, news = learned_parts()
    cell = int(news.cells[np.argmax(news.blocks["rows"])])
    after = faded(past, news, 0.0, 0.0, np.array([cell]))
    k = int(np.flatnonzero(past.cells == cell)[0])
    own = 2 + 6 * k
    ratio = after.normal().gram[own, own] / past.normal().gram[own, own]
    assert abs(ratio - (1 - CHANGED)) < 1e-6
