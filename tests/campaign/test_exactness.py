"""Recursive = batch over random machines."""

from __future__ import annotations

import pytest

from tests.campaign.report import leave
from tests.estimator.cases import draw_case, plant_case
from tests.estimator.test_batch import differences, parameter_error


@pytest.mark.campaign
@pytest.mark.parametrize("form", ["integral", "carry"])
def test_recursive_equals_batch(form: str) -> None:
    """Sums and parameters to 1e-8.

    The carry form has 50 rows per second for some 300 unknowns: there normal equations, batch's own
    as well, lose the digits of weakly known parameters: this bound is not reached.
    """
    cases = [plant_case(seed, form, seed % 3 == 2, duration_s=8.0) for seed in range(20)]
    parameters = max(parameter_error(case) for case in cases)
    sums = max(differences(case)["gram"] for case in cases)
    figure = f"sums {sums:.1e}, parameters {parameters:.1e}"
    leave(f"recursive against batch, {form} form", figure, "1e-8", f"{len(cases)} plants, 8 s")
    assert sums <= 1e-8
    assert parameters <= 1e-8


@pytest.mark.campaign
@pytest.mark.parametrize("form", ["integral", "carry"])
def test_up_to_twenty_shared_columns(form: str) -> None:
    cases = [draw_case(100 + terms, form, terms=terms) for terms in range(19)]
    sums = max(differences(case)["gram"] for case in cases)
    leave(
        f"recursive against batch, 2 to 20 shared columns, {form} form",
        f"sums {sums:.1e}",
        "1e-8",
        f"{len(cases)} random declarations",
    )
    assert sums <= 1e-8
