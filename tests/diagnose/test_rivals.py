"""Two causes that both leave a misfit, and whether the blocks of a record tell them apart."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.diagnose import admission, contest, rivals
from rtid.diagnose.admission import is_as_credible, makes_impossible
from rtid.diagnose.evidence import rows_of
from rtid.diagnose.fit import Fit, fit, one_pass, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.rivals import CLEARLY, is_told_apart, loss
from rtid.diagnose.trials import Trial, TrialState, best_by_key, scored, with_effect
from rtid.plain import FloatArray, silent
from tests.diagnose.records import noisy, record

ROWS, BLOCKS = 4000, 40


@cache
def fits() -> tuple[Fit, Fit]:
    """Of a record with a leak: without an effect, and with it."""
    model, chunk, _ = record("external_leakage_laminar", 3e-12)
    weights = prepare(model, chunk)
    plain = one_pass(model, chunk, weights, Revision(), None, bank=True)
    leak = best_by_key(plain, scored(plain))["external_leakage_laminar", "a"][0]
    revision = with_effect(plain, leak)
    return plain, one_pass(model, chunk, weights, revision, plain, bank=False)


def test_the_rows_lose_what_the_fit_loses() -> None:
    plain, leaking = fits()
    lost = [float(loss(fit, fit.own_rows).sum()) for fit in (plain, leaking)]
    assert leaking.wins_over(plain) > 1000.0
    assert lost[0] - lost[1] == pytest.approx(leaking.wins_over(plain), rel=0.02)


def test_a_leak_is_told_from_nothing_and_nothing_from_a_leak_never() -> None:
    plain, leaking = fits()
    assert is_told_apart(leaking, plain)
    assert not is_told_apart(plain, leaking)
    assert not is_told_apart(leaking, leaking)


def without_a_row(fitted: Fit, sample: int) -> Fit:
    """The same revision, fitted where a sample has left the grids."""
    chunk = fitted.chunk.copy()
    for command in {edge.command for edge in fitted.declared.edges}:
        chunk[sample, 2 + fitted.declared.column(command)] = 1e3
    record = fitted.declared, chunk, fitted.weights, fitted.revision, None
    return one_pass(*record, bank=False, thorough=False, before=fitted.before)


@pytest.mark.parametrize("sample", [1010, 7013])
def test_rows_that_one_fit_alone_has_tell_nothing(sample: int) -> None:
    """A fit was told from itself less a row of 3,000; without an effect, less one, it won over the
    leak.
    """
    plain, leaking = fits()
    less, plainly_less = (without_a_row(fitted, sample) for fitted in (leaking, plain))
    assert 0 < leaking.own_rows.n - less.own_rows.n < 0.01 * leaking.own_rows.n
    assert not is_told_apart(leaking, less) and not is_told_apart(less, leaking)
    assert is_told_apart(leaking, plainly_less) and is_told_apart(less, plain)
    assert not is_told_apart(plainly_less, leaking) and not is_told_apart(plain, less)


@pytest.mark.parametrize("sample", range(1010, 1020))
def test_rows_of_two_fits_are_paired_by_their_time(sample: int) -> None:
    """Also where those of one begin some samples later, behind what left its grids alone."""
    _, leaking = fits()
    rows, less = (fitted.own_rows for fitted in (leaking, without_a_row(leaking, sample)))
    for each in (rows, less):
        assert len(each.weighed.first) == len(each.weighed.last) == len(each.own)
        assert each.weighed.log_noise.sum() == pytest.approx(each.log_noise)
    at, others = rows.weighed.paired(less.weighed)
    assert set(range(90)) <= set(at) and 100 not in at
    assert len(rows.own) - len(at) < 10
    assert len(set(at)) == len(set(others)) == len(at)
    assert np.abs(rows.weighed.last[at] - less.weighed.last[others]).max() <= 5  # of 10
    assert abs(len(less.weighed.paired(rows.weighed)[0]) - len(at)) <= 1


def test_rows_are_paired_with_themselves() -> None:
    rows = fits()[1].own_rows
    whole = np.arange(len(rows.own))
    np.testing.assert_array_equal(rows.weighed.paired(rows.weighed), (whole, whole))


def test_what_spreads_the_rows_wins_as_little_with_a_row_less() -> None:
    """915 of ln det were dropped for a sample off the grids: a volume that is not there won by 825,
    and not by -215.
    """
    plain, leaking = fits()
    volume = best_by_key(plain, scored(plain))["extra_dead_volume", "a"][0]
    revision = replace(with_effect(leaking, volume), sizes=((volume, 5e-4),))
    record = leaking.declared, leaking.chunk, leaking.weights, revision, leaking
    soft = one_pass(*record, bank=False, thorough=False)
    spread = soft.own_rows.log_noise - leaking.own_rows.log_noise
    wins = soft.wins_over(leaking)
    assert spread > 500.0 and wins < 0.0
    less = without_a_row(soft, 1013)
    assert less.wins_over(leaking) == pytest.approx(wins, abs=0.2 * spread)
    assert leaking.wins_over(less) == pytest.approx(-wins, abs=0.2 * spread)


@pytest.mark.long
def test_what_is_out_of_reach_as_it_stands_is_told_apart_at_its_end_too() -> None:
    """And what does the same as the best one, or next to it, is fitted to its end."""
    plain, leaking = fits()
    state = TrialState(plain.declared, plain.chunk, plain.chunk, silent)
    trials = [
        Trial(key, score.gain, with_effect(plain, candidate))
        for key, (candidate, score) in best_by_key(plain, scored(plain)).items()
        if score.gain > 0.2 * leaking.wins_over(plain)
    ]
    far = {t.key: contest._is_out_of_reach(state, plain, leaking, t) for t in trials}
    assert not far["external_leakage_laminar", "a"] and sum(far.values()) > 0
    for t in trials:
        end = contest._finished(state, plain, t).fit
        assert end is not None and (is_told_apart(leaking, end) or not far[t.key])


def test_rows_that_were_let_go_are_made_again_as_soft() -> None:
    """What more than the declared volume stores is in what the pressures' noise is taken for."""
    model, chunk, _ = record("extra_dead_volume", 4e-4)
    weights = prepare(model, chunk)
    plain = one_pass(model, chunk, weights, Revision(), None, bank=True)
    volume = best_by_key(plain, scored(plain))["extra_dead_volume", "a"][0]
    fitted = fit(model, chunk, weights, with_effect(plain, volume), plain, bank=False)
    again, rows = fitted.light().own_rows, fitted.rows
    assert rows is not None and rows.soft.max() > 0.0
    np.testing.assert_array_equal(again.whiten, rows.whiten)
    np.testing.assert_array_equal(again.own, rows.own)
    unsoft = rows_of(fitted.model, fitted.sent, fitted.weights)
    assert np.abs(unsoft.whiten / again.whiten - 1.0)[:, 0].max() > 1e-3


def test_what_a_cause_may_still_gain_is_no_difference() -> None:
    plain, leaking = fits()
    assert is_told_apart(leaking, plain, 0.1 * leaking.wins_over(plain))
    assert not is_told_apart(leaking, plain, leaking.wins_over(plain))


@pytest.fixture
def differ(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Two fits of one chamber whose rows differ as given, in blocks of equal length."""
    block = np.repeat(np.arange(BLOCKS), ROWS // BLOCKS)
    whole = np.arange(ROWS)
    rows = SimpleNamespace(
        own=np.zeros((ROWS, 1, 2)), weighed=SimpleNamespace(paired=lambda _: (whole, whole))
    )
    monkeypatch.setattr(rivals, "blocks_of", lambda rows, chamber: block)

    def told(apart: FloatArray) -> bool:
        monkeypatch.setattr(rivals, "loss", lambda fit, rows: fit.loses * apart)
        best, other = (SimpleNamespace(own_rows=rows, loses=share) for share in (0.0, 1.0))
        return is_told_apart(best, other)  # type: ignore[arg-type]

    return told


def test_what_one_block_likes_better_tells_nothing(differ: Any) -> None:
    """All rows of a block miss the same flow: they are one witness, however many they are."""
    rng = np.random.default_rng(1)
    noise = noisy(rng, ROWS)
    everywhere = noise + 2.0 * CLEARLY / np.sqrt(ROWS)
    one_block = np.where(np.arange(ROWS) < ROWS // BLOCKS, everywhere.sum() / (ROWS // BLOCKS), 0.0)
    assert differ(everywhere)
    assert not differ(one_block)
    assert not differ(noise - noise.mean())
    assert not differ(-everywhere)


def test_a_chamber_s_rows_are_in_the_blocks_of_its_own_edges() -> None:
    plain, _ = fits()
    rows = plain.own_rows
    of_a, of_b = (rivals.blocks_of(rows, c) for c in (0, 1))
    for c, block in enumerate((of_a, of_b)):
        moving = block < len(rows.cells)
        assert moving.any() and (rows.sign[block[moving], c] != 0).all()
        assert len(set(block[~moving])) == (~moving).sum() > 0  # each shut row is one alone


@pytest.mark.parametrize(
    ("before", "after", "refuted"),
    [
        ((), (), False),
        ((), (True,), True),
        ((), (False,), False),  # moduli that contradict each other may be a wall's
        ((True,), (True,), False),  # it was impossible before
    ],
)
def test_a_cause_beside_which_no_oil_is_possible_is_refuted(
    monkeypatch: pytest.MonkeyPatch,
    before: tuple[bool, ...],
    after: tuple[bool, ...],
    refuted: bool,
) -> None:
    """A line beside a sag that was half explained left 19 GPa of oil."""
    monkeypatch.setattr(admission, "told_doubts", doubts)
    assert makes_impossible(before, after) is refuted  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("before", "after", "credible"),
    [
        ((), (), True),
        ((), (False,), False),
        ((False,), (False,), True),  # they contradict each other either way
        ((False,), (True,), False),  # which is no licence to make one impossible
        ((True,), (True,), True),
        ((True,), (), True),
    ],
)
def test_what_the_residual_hardly_shows_leaves_moduli_as_credible(
    monkeypatch: pytest.MonkeyPatch,
    before: tuple[bool, ...],
    after: tuple[bool, ...],
    credible: bool,
) -> None:
    """On a sweep with a leak of 4 % of the flow a line was named that left 1326 and 1852 MPa."""
    monkeypatch.setattr(admission, "doubts_about", doubts)
    monkeypatch.setattr(admission, "told_doubts", doubts)
    assert is_as_credible(before, after) is credible  # type: ignore[arg-type]


def doubts(fit: Any) -> tuple[Any, ...]:
    """Of a fit that is no more than whether each of its doubts is of what cannot be."""
    return tuple(SimpleNamespace(is_invalid=invalid) for invalid in fit)
