"""Told directions hold all that entries have of their blocks, and no more than a prior's share."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtid.diagnose.directions import Directions
from rtid.estimator.factor import PRIOR_SD
from rtid.kernels.layout import TERMS
from rtid.plain import FloatArray, IntArray


def entries(seed: int, ranks: list[int]) -> tuple[IntArray, FloatArray]:
    """Nine entries per block that lie in so many directions, whose sizes are decades apart."""
    rng, block, terms = np.random.default_rng(seed), [], []
    for v, rank in enumerate(ranks):
        ways = rng.standard_normal((rank, TERMS)) * 10.0 ** -rng.uniform(0.0, 2.0, (rank, 1))
        block.append(np.full(9, v))
        terms.append(rng.standard_normal((9, rank)) @ ways)
    return np.concatenate(block), np.concatenate(terms)


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, TERMS), min_size=1, max_size=5))
def test_what_entries_have_is_told(seed: int, ranks: list[int]) -> None:
    block, terms = entries(seed, ranks)
    span, along = Directions.of(block, terms, len(ranks), 1e6)
    assert np.diff(span.first).tolist() == ranks and span.n == sum(ranks)
    back = np.einsum("npq,nq->np", span.basis[block], along)
    np.testing.assert_allclose(back, terms, rtol=0, atol=1e-12 * np.abs(terms).max(initial=1.0))
    whole = np.array(ranks) == TERMS
    assert np.array_equal(span.basis[whole], np.broadcast_to(np.eye(TERMS), (whole.sum(), 6, 6)))
    assert np.array_equal(along[whole[block]], terms[whole[block]])


def test_what_weighs_next_to_nothing_beside_the_prior_is_left_to_it() -> None:
    block, terms = entries(1, [TERMS])
    sizes = [Directions.of(block, terms, 1, weight)[0].n for weight in (1e6, 1e-9, 1e-30)]
    assert sizes[0] == TERMS and sizes[2] == 0 and sizes == sorted(sizes, reverse=True)


@pytest.mark.parametrize("rank", [0, 2, TERMS])
def test_what_is_not_told_is_as_the_prior_says(rank: int) -> None:
    block, terms = entries(2, [rank])
    span, _ = Directions.of(block, terms, 1, 1e6)
    told = np.zeros((1, TERMS, TERMS))
    told[0, range(rank), range(rank)] = 0.25
    (cov,) = span.covariances(told)
    wide = np.linalg.eigvalsh(cov)
    np.testing.assert_allclose(wide, [0.25] * rank + [PRIOR_SD**2] * (TERMS - rank))
    assert span.terms(np.ones((3, rank))).shape == (3, 1, TERMS)
