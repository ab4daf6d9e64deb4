"""A gain that walks at random: exact, followed, forgotten by nothing else, and to the bit.

Records and model of `test_gate`, as for all upkeep.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.estimator.sums import Sums
from rtid.estimator.walking import Gain, gain_of, walked
from rtid.model import Upkeep
from rtid.plain import FloatArray
from rtid.trace.snapshot import load, save
from tests.estimator.test_gate import exact_model, exact_record
from tests.estimator.test_upkeep import assert_same, learned

WALKS = Upkeep(0.5, folds=3, gain_walk=0.01)
N = 6000


@pytest.fixture(scope="module")
def record() -> FloatArray:
    return exact_record(90_000)[:N].copy()


@pytest.fixture(scope="module")
def past_and_news(record: FloatArray) -> tuple[Sums, Sums]:
    alone = Upkeep()
    past, both = learned(record[: N // 2], upkeep=alone), learned(record, upkeep=alone)
    return past.sums, both.sums - past.sums


def test_what_walks_is_one_unknown_more(past_and_news: tuple[Sums, Sums]) -> None:
    """The normal equations of [theta, w], y = Phi theta - w Phi d, with w taken out."""
    past, news = past_and_news
    gain = gain_of(exact_model(Upkeep()), past + news)
    before, after = past.normal(), walked(past, news, gain, variance := 1e-10).normal()
    d = gain.among(past)
    column, toward = -before.gram @ d, -d @ before.right
    own = d @ before.gram @ d + 1.0 / variance
    gram = before.gram - np.outer(column, column) / own
    right = before.right - column * toward / own
    np.testing.assert_allclose(after.gram, gram, atol=1e-12 * np.abs(gram).max())
    np.testing.assert_allclose(after.right, right, atol=1e-12 * np.abs(right).max())
    assert after.square == pytest.approx(before.square - toward**2 / own)
    assert (after.noise == before.noise).all() and after.rows == before.rows


def test_only_the_gain_is_known_less_and_the_estimate_stays(
    past_and_news: tuple[Sums, Sums],
) -> None:
    """The covariance grows by that of the step along d, and by nothing else."""
    past, news = past_and_news
    known = past.normal()
    theta = np.linalg.lstsq(known.gram, known.right, rcond=None)[0]
    terms: FloatArray = np.asarray(theta[past.n_shared :].reshape(-1, 6), np.float64)
    after = walked(past, news, Gain(past.cells, terms), variance := 1e-6).normal()
    ridge = 1e-9 * np.diag(np.diag(known.gram)) + 1e-12 * np.eye(len(theta))
    wider = np.linalg.inv(after.gram + ridge) - np.linalg.inv(known.gram + ridge)
    d = np.concatenate([np.zeros(past.n_shared), terms.ravel()])
    added = d @ known.gram @ wider @ known.gram @ d / (d @ known.gram @ d) ** 2
    assert added == pytest.approx(variance, rel=1e-3)
    np.testing.assert_allclose(
        after.gram @ theta, after.right, atol=1e-9 * np.abs(known.right).max()
    )


def test_a_machine_that_tells_nothing_of_its_gain_forgets_nothing(
    past_and_news: tuple[Sums, Sums],
) -> None:
    past, news = past_and_news
    gain = gain_of(exact_model(Upkeep()), past + news)
    nothing = replace(news, blocks=news.blocks[:0], pairs=news.pairs[:0], tiles=news.tiles[:0])
    assert walked(past, nothing, gain, 1.0) is past
    still = replace(gain, terms=0.0 * gain.terms)
    np.testing.assert_array_equal(walked(past, news, still, 1.0).normal().gram, past.normal().gram)


@pytest.mark.parametrize("size", [1, 7, 4096])
def test_live_is_replay(size: int, record: FloatArray) -> None:
    part = record[:3000] if size == 1 else record
    assert_same(learned(part, upkeep=WALKS), learned(part, size, WALKS))


def test_reset_copy_and_restore_go_on_to_the_bit(record: FloatArray, tmp_path: Path) -> None:
    whole, half = learned(record, upkeep=WALKS), learned(record[: N // 2], upkeep=WALKS)
    save(tmp_path / "walking.npz", half, "digest")
    restored = load(tmp_path / "walking.npz", half.model, "digest")
    for each in (half.copy(), restored, half):
        each.advance(record[N // 2 :])
        assert_same(whole, each)
    half.reset()
    half.advance(record)
    assert_same(whole, half)
