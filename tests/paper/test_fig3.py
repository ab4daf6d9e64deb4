"""Fig. 3 of the paper: rms error at most 1 % of full scale, jump with windows at most a tenth."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.paper.fig3 import FINE, SURFACES
from benchmarks.paper.function import THETA, declared, grid, record, true_value
from benchmarks.paper.surface import Estimate, errors, excess, full_scale, jumps, learn, rms
from rtid.model import LAPPED, TAYLOR
from rtid.plain import FloatArray


@pytest.fixture(scope="module")
def chunk() -> FloatArray:
    return record(seed=11)


@pytest.fixture(scope="module")
def estimates(chunk: FloatArray) -> dict[str, Estimate]:
    return {basis: learn(chunk, grid(FINE), basis) for basis in SURFACES}


def test_the_function_is_not_smooth_and_its_dead_band_ends_between_1_and_2() -> None:
    x = np.linspace(0, 4, 41)
    assert (true_value(1.3, x) == 0).all()
    assert (true_value(1.75, x) > 0).all()
    slope = np.diff(true_value(np.array([1.39999, 1.4, 1.40001]), 1.0)) / 1e-5
    assert slope[0] == 0
    assert slope[1] > 0.4


def test_frames_carry_the_record(chunk: FloatArray) -> None:
    """Every row arrived, and u and x stand where the model looks for them."""
    model = declared(grid())
    assert len(chunk) == 120_000
    for name, low, high in (("u", 0.0, 5.0), ("x", 0.0, 4.0)):
        column = chunk[:, 2 + model.column(name)]
        assert low <= column.min() < low + 0.1
        assert high - 0.1 < column.max() <= high


@pytest.mark.long
@pytest.mark.parametrize("basis", SURFACES)
def test_rms_error_is_at_most_one_percent(estimates: dict[str, Estimate], basis: str) -> None:
    assert estimates[basis].valid_share > 0.9
    assert rms(errors(estimates[basis])) < 0.01


def test_windows_leave_a_tenth_of_the_jump(estimates: dict[str, Estimate]) -> None:
    taylor, lapped = estimates[TAYLOR], estimates[LAPPED]
    without = rms(jumps(taylor.grid, taylor.unwindowed))
    assert without > 0.001
    assert rms(jumps(taylor.grid, taylor.published.flow)) < 0.1 * without
    assert rms(jumps(lapped.grid, lapped.windowed)) < 0.1 * without


@pytest.mark.parametrize("basis", [TAYLOR, LAPPED])
def test_windows_leave_a_tenth_of_the_change_over_a_border(
    estimates: dict[str, Estimate], basis: str
) -> None:
    """The plain count: all change beyond the truth's, that of a steep estimate too."""
    own, taylor = estimates[basis], estimates[TAYLOR]
    surface = own.published.flow if basis == TAYLOR else own.windowed
    share = rms(excess(own.grid, surface)) / rms(excess(taylor.grid, taylor.unwindowed))
    print(f"{basis}: {100 * share:.2f} %")
    assert share < 0.1


def test_a_corner_is_no_jump_and_a_step_is_one() -> None:
    blocks = grid(1.0)
    kink = jumps(blocks, lambda u, x: np.asarray(np.maximum(u - 2.0, 0.0) + 0.3 * x))
    np.testing.assert_allclose(kink, 0.0, atol=1e-12)
    step = jumps(blocks, lambda u, x: np.where(u > 2.0, 1.0, 0.0))
    assert np.unique(np.abs(step).round(6)).tolist() == [0.0, round(1 / full_scale(), 6)]


def test_the_parameter_is_found_beside_the_function(estimates: dict[str, Estimate]) -> None:
    solution = estimates[TAYLOR].solution
    sd = float(np.sqrt(solution.terms_cov[0, 0]))
    assert abs(solution.terms[0] - THETA) < 4 * sd
    assert sd < 1e-3


def test_fine_spacing_where_the_dead_band_may_end_halves_the_error(
    chunk: FloatArray, estimates: dict[str, Estimate]
) -> None:
    coarse = learn(chunk, grid(1.0), TAYLOR)
    assert rms(errors(estimates[TAYLOR])) < 0.5 * rms(errors(coarse))
