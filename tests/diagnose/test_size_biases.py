"""What noise and the terms' misfit have made of a size is taken off as far as it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose import size_biases as biases
from rtid.diagnose.attenuation import NOTHING_TOLD, Believed
from rtid.diagnose.consequence import on_finer
from rtid.diagnose.fit import Fit, one_pass, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.rising import NO_BIAS, SizeBias, given_volumes, risings
from rtid.diagnose.size_biases import size_biases
from rtid.diagnose.trials import best_by_key, scored, with_effect
from rtid.estimator.refine import halved_along
from rtid.model import Machine
from rtid.units import UNIFORM
from tests.diagnose.records import record

LEAK = "internal_leakage_laminar", "a-b"
HERE = Believed(1.0, 0.03, 0.02)


@pytest.fixture(scope="module")
def leaking() -> tuple[Fit, int]:
    """A machine that leaks, with the leak, and its column."""
    model, chunk, _ = record(LEAK[0], 2e-12)
    weights = prepare(model, chunk)
    plain = one_pass(model, chunk, weights, Revision(), None, bank=True)
    leak = best_by_key(plain, scored(plain))[LEAK][0]
    fitted = one_pass(model, chunk, weights, with_effect(plain, leak), plain, bank=False)
    return fitted, fitted.column(leak)


def test_a_move_within_its_noise_tells_of_no_bias() -> None:
    there = Believed(1.03, 0.05, 0.02)  # the move's own deviation is 0.04
    assert biases._of_grid(1.0, HERE, there) == NO_BIAS
    assert biases._of_grid(1.0, HERE, NOTHING_TOLD) == NO_BIAS


def test_a_move_far_beyond_its_noise_is_all_bias() -> None:
    bias = biases._of_grid(1.0, HERE, Believed(5.0, 0.05, 0.02))
    assert bias.shift == pytest.approx(4.0, rel=1e-3)
    assert bias.sd == pytest.approx(np.hypot(4.0 / UNIFORM, 0.04), rel=1e-3)


@pytest.mark.parametrize("sd", [0.02, 0.05, 0.2])
def test_it_is_shrunk_as_its_noise_says(sd: float) -> None:
    """Of a bias of variance t^2, seen with the variance v, t^2 / (t^2 + v) is believed."""
    there = Believed(1.2, float(np.hypot(0.03, sd)), 0.02)
    bias = biases._of_grid(1.0, HERE, there)
    t2 = max(0.0, 0.2**2 - sd**2)
    assert bias.shift == pytest.approx(0.2 * t2 / (t2 + sd**2))
    assert abs(bias.shift) <= 0.2


def test_biases_add_up_and_an_impossible_one_widens() -> None:
    both = SizeBias(0.3, 0.03).beside(SizeBias(-0.1, 0.04))
    assert (both.shift, both.sd) == pytest.approx((0.2, 0.05))
    assert (both.unknown().shift, both.unknown().sd) == pytest.approx((0.0, np.hypot(0.2, 0.05)))


def test_where_noise_is_all_that_is_left_nothing_is_moved(leaking: tuple[Fit, int]) -> None:
    fitted, column = leaking
    assert biases._of_noise(fitted, NOTHING_TOLD, column) == NO_BIAS


def test_on_rich_motion_a_size_over_the_record_is_hardly_another(leaking: tuple[Fit, int]) -> None:
    """How the gap widens is counted on both grids: what is left is no bias of the terms."""
    fitted, column = leaking
    (leak,) = fitted.revision.effects
    over = risings(fitted, given_volumes(fitted), [leak])
    bias, plain = size_biases(fitted, over)[column], over[column].bias
    assert abs(bias.shift - plain.shift) < 0.01 * fitted.held.value(column)
    assert bias.sd < 0.01 * fitted.held.value(column)


def test_a_finer_grid_weighs_each_row_as_the_coarse_one(leaking: tuple[Fit, int]) -> None:
    """Also where an interval of dp is left whole, as noise would flatten the slopes in its halves.

    Values that were dealt out as if all had been halved were those of other blocks.
    """
    fitted, _ = leaking
    machine = _noisy(fitted.declared)
    slopes = np.arange(1.0, machine.n_cells + 1.0)
    weights = replace(fitted.weights, slopes=slopes, missed=np.zeros_like(slopes))
    finer = on_finer(replace(fitted, declared=machine, weights=weights))
    assert finer is not None
    coarse, cut = (m.maps[0].grid for m in (machine, finer.declared))
    assert cut.shape[1] < 2 * coarse.shape[1], "one was left whole"
    for a, u in enumerate(0.5 * (cut.u_v[1:] + cut.u_v[:-1])):
        for b, dp in enumerate(0.5 * (cut.dp_pa[1:] + cut.dp_pa[:-1])):
            at = np.searchsorted(coarse.u_v, u) - 1, np.searchsorted(coarse.dp_pa, dp) - 1
            expected = slopes[int(at[0]) * coarse.shape[1] + int(at[1])]
            assert finer.weights.slopes[a * cut.shape[1] + b] == expected


def _noisy(machine: Machine) -> Machine:
    """The machine with so much noise of its pressures that a narrow interval of dp stays whole."""
    for times in (1.0, 2.0, 4.0, 8.0):
        signals = tuple(
            replace(s, noise=times * s.noise) if s.name.startswith("p_") else s
            for s in machine.signals
        )
        noisier = replace(machine, signals=signals)
        shape = halved_along(noisier, 1).maps[0].grid.shape
        if shape[1] < 2 * machine.maps[0].grid.shape[1]:
            return noisier
    raise AssertionError("no interval stays whole")
