"""Three cases that break the usual recursions, beside padasip and filterpy on the same data.

A long standstill with forgetting, model error in the blocks of the dead band's corner, and a record
that begins with nearly collinear rows.  `tests.campaign.test_hard_cases` has them at full length.
"""

from __future__ import annotations

import numpy as np
import pytest

from rtid.estimator.estimator import Estimator
from tests.estimator.collinear import condition, error_at_the_end, record
from tests.estimator.corner import FIRST_SEED, fits
from tests.estimator.rivals import RIVALS, OneBlock
from tests.estimator.standstill import COARSE, WAYS, stand, stand_rival
from tests.estimator.test_batch import parameter_error

TWENTY_MINUTES_S = 1200.0
FIRST_ROWS = 100


@pytest.mark.parametrize("way", WAYS)
def test_standstill(way: str) -> None:
    """The harshest forgetting: its time constant is as short as the time between two turns."""
    found = stand(way, TWENTY_MINUTES_S, 60.0, COARSE)
    print(f"{way}: {found}")
    assert found.finite
    assert found.blocks > 20
    assert found.lowest > 1e-9
    assert found.drift < 0.01
    assert np.abs(found.beta_drift).max() < 0.01


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", RIVALS)
def test_standstill_breaks_a_covariance_that_forgets(name: str) -> None:
    """At lambda = 0.999 within a minute of samples at 1 kHz; none of them says so."""
    loss = stand_rival(RIVALS[name], "against the stop", 30_000)
    print(f"{name}: {loss}")
    assert loss.indefinite is not None
    assert loss.wrong is not None


@pytest.mark.long
@pytest.mark.slow
def test_corner_of_the_dead_band() -> None:
    """Within 5 % and within the stated interval, which chance alone breaks in 5 % of the cases."""
    found = fits(range(FIRST_SEED, FIRST_SEED + 10), "rich")
    print(f"{len(found.lag_error_s)} machines: {found}")
    assert len(found.lag_error_s) >= 10
    assert np.abs(found.error).max() < 0.05
    assert found.covered >= 0.9
    assert np.abs(found.z).max() < 3.5


@pytest.mark.parametrize("seed", [1, 5])
def test_collinear_start(seed: int) -> None:
    """Finite after any number of samples, and batch least squares at the end."""
    case = record(seed, 2.0)
    estimator, taken = Estimator(case.model), 0
    for count in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, len(case.chunk)):
        estimator.advance(case.chunk[taken:count])
        taken = count
        solution = estimator.solution()
        assert np.isfinite(solution.unknowns).all()
        assert np.isfinite(solution.compliance_cov).all()
        assert all(np.isfinite(block.cov).all() for block in solution.blocks)
    error = parameter_error(case)
    print(f"seed {seed}: against batch {error:.1e}")
    assert error <= 1e-8


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", RIVALS)
def test_collinear_start_ruins_what_inverts_the_first_rows(name: str) -> None:
    """One block: from nothing it ends well, from the first rows it does not."""
    case = record(1, 2.0)
    rows = OneBlock(case.model, (1.0, 4.5), (-0.3e6, 10e6)).rows(case.chunk)
    kappa = condition(rows[:FIRST_ROWS, :-1])
    nothing, inverted = (error_at_the_end(RIVALS[name], rows, n) for n in (0, FIRST_ROWS))
    print(f"{name}: {nothing:.1e}, from {FIRST_ROWS} rows of condition {kappa:.0e} {inverted:.1e}")
    assert 1e8 < kappa < 1e13
    assert nothing < 1e-5
    assert not inverted < 1e-3  # it may be NaN
