"""What a fit leaves, weighed for what it has found: the noise of the rows is no explanation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import pytest

from rtid.diagnose.admission import is_spread_alone
from rtid.diagnose.fit import Fit, fit, one_pass, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.trials import best_by_key, scored, with_effect
from tests.diagnose.records import record

LEAST = 16.0


@cache
def fits() -> tuple[Fit, Fit]:
    """Of the paper's sweep of a clean machine: without an effect, and with a dead volume at b."""
    model, chunk, _ = record(motion="sweep")
    plain = fit(model, chunk, prepare(model, chunk), Revision())
    volume = best_by_key(plain, scored(plain))["extra_dead_volume", "b"][0]
    revision = with_effect(plain, volume)
    return plain, fit(model, chunk, plain.weights, revision, plain, bank=False)


def weighed(plain: Fit, share: float) -> Fit:
    """The plain fit again, for an oil that is softer by so much: it hardly finds another one."""
    weights = replace(plain.weights, compliance=(1.0 + share) * plain.compliance)
    return one_pass(plain.declared, plain.chunk, weights, plain.revision, plain, bank=False)


def test_it_is_the_same_however_the_rows_had_been_weighed() -> None:
    plain, _ = fits()
    settled = weighed(plain, 0.0)
    assert settled.settled_chi2 == pytest.approx(settled.held.sse, rel=1e-3)
    for share in (-0.1, 0.1):
        off = weighed(plain, share)
        assert abs(off.held.sse / settled.held.sse - 1.0) > 0.05, "it falls with the weights"
        assert off.settled_chi2 == pytest.approx(settled.held.sse, rel=0.01)


def test_a_volume_that_is_none_explains_nothing_once_it_is_settled() -> None:
    plain, volume = fits()
    assert abs(plain.settled_chi2 - volume.settled_chi2) < 0.01 * plain.regression.dof


@pytest.mark.parametrize(
    ("fallen", "risen", "settled", "is_alone"),
    [
        (10.0, -500.0, 500.0, True),  # it explains nothing, however quiet the rows become
        (1421.0, 0.0, 0.0, False),  # as noisy as they were: nobody asks
        (1421.0, 1484.0, 1213.0, False),  # a leak, and the oil that had stood in for it
        (730.0, 815.0, -110.0, True),  # a line on a clean sweep
        (207.0, 333.0, 60.0, True),  # one more, beside noise that was taken for too large
    ],
)
def test_what_only_spreads_the_rows_explains_nothing(
    fallen: float, risen: float, settled: float, is_alone: bool
) -> None:
    def of(excess: float, settled_chi2: float) -> Any:
        of_record = {"excess": excess, "settled_chi2": settled_chi2}
        return SimpleNamespace(**of_record, wins_over=lambda _: fallen - risen)

    present, now = of(9000.0, settled), of(9000.0 - fallen, 0.0)
    assert is_spread_alone(present, now, LEAST) is is_alone
