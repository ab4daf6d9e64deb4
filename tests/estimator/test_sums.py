"""Accumulators: parts add up to the whole, draining loses nothing, blocks have no order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.estimator.estimator import Estimator
from rtid.estimator.state import build
from rtid.estimator.sums import Normal, Sums
from rtid.model import BASES, Upkeep
from tests.estimator.cases import Case, draw_case

MERGED_LIMIT = 1e-10
FORMS = ("integral", "carry", "restart")


def by_cell(sums: Sums) -> Normal:
    """Normal equations with the blocks in the order of their cells."""
    order = np.argsort(sums.cells)
    own = sums.n_shared + 6 * order[:, None] + np.arange(6)
    at = np.concatenate([np.arange(sums.n_shared), own.ravel()])
    normal = sums.normal()
    return replace(normal, gram=normal.gram[np.ix_(at, at)], right=normal.right[at])


def difference(a: Sums, b: Sums) -> float:
    """Largest difference of the products, each column in units of its own size."""
    one, other = by_cell(a), by_cell(b)
    diagonal = np.diag(one.gram)
    size = np.sqrt(np.where(diagonal > 0, diagonal, 1e-12 * diagonal.max()))
    return max(
        float(np.abs((one.gram - other.gram) / np.outer(size, size)).max()),
        float(np.abs((one.right - other.right) / size).max() / np.sqrt(one.square)),
        abs(one.square / other.square - 1),
    )


def learned(case: Case) -> Sums:
    state = build(case.model)
    state.advance(case.chunk)
    return Sums.of(state)


@pytest.mark.parametrize("form", FORMS)
def test_parts_drained_on_the_way_add_up_to_the_whole(form: str) -> None:
    case = draw_case(700, form, n=3000, faults=2)
    state, parts = build(case.model), []
    for k in range(0, 3000, 250):
        state.advance(case.chunk[k : k + 250])
        parts.append(Sums.drained(state))
    rng = np.random.default_rng(0)
    for order in (range(len(parts)), rng.permutation(len(parts))):
        total = parts[order[0]]
        for k in order[1:]:
            total = total + parts[k]
        whole = learned(case)
        assert difference(whole, total) <= MERGED_LIMIT
        for name in ("rows", "dwell_s", "phi_sum"):
            mine, other = (np.sort(s.blocks[name], axis=0) for s in (whole, total))
            np.testing.assert_allclose(mine, other, rtol=1e-9, atol=1e-12)


def test_records_of_two_days_add_up_to_one_with_a_gap() -> None:
    first, second = draw_case(701, n=1500), draw_case(702, n=1500)
    second = replace(second, model=first.model)
    both = np.vstack([first.chunk, second.chunk])
    both[1500:, 0] += 1000.0
    state = build(first.model)
    state.advance(both)
    assert difference(Sums.of(state), learned(first) + learned(second)) <= MERGED_LIMIT
    assert difference(Sums.of(state), learned(second) + learned(first)) <= MERGED_LIMIT


@pytest.mark.parametrize("basis", BASES)
def test_folds_are_the_whole(basis: str) -> None:
    case = draw_case(703, n=4000, basis=basis)
    upkeep = Upkeep(every_s=0.25, folds=5)
    folded = Estimator(replace(case.model, upkeep=upkeep))
    folded.advance(case.chunk)
    assert all(fold.rows > 100 for fold in folded.folds[:4])
    assert difference(learned(case), folded.sums) <= MERGED_LIMIT


def test_sums_of_other_weights_are_refused() -> None:
    case = draw_case(704)
    other = replace(case, model=replace(case.model, beta_nominal_pa=9e8))
    with pytest.raises(ValueError, match="different weights"):
        learned(case) + learned(other)


def test_normal_equations_survive_the_way_back() -> None:
    sums = learned(draw_case(705))
    again = sums.with_normal(sums.normal())
    assert difference(sums, again) == 0.0
