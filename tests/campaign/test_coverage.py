"""Do the 95 % intervals hold, truncation of the blocks included?  And is theta_beta unbiased?

Each plant is drawn, simulated for 15 to 20 s and learned from with the default grid.  In CI a few
plants show that nothing is broken; `make campaign` shows the figures.
"""

from __future__ import annotations

import numpy as np
import pytest

from rtid.plain import FloatArray
from tests.campaign.plants import Score, Trial, score, scores
from tests.campaign.report import leave

FIRST_SEED = 1000  # not the plants that development looked at
Z95 = 1.96


def of(result: list[Score], name: str) -> FloatArray:
    return np.concatenate([getattr(s, name) for s in result])


def covered(z: FloatArray) -> float:
    return float((np.abs(z) < Z95).mean())


@pytest.mark.first_of(1)
@pytest.mark.parametrize("motion", ["rich", "sweep"])
def test_a_few_plants(motion: str) -> None:
    """Bounds that chance alone breaks once in some thousand runs."""
    trials = [Trial(FIRST_SEED + k, motion, 12.0) for k in range(5)]
    found = [s for s in map(score, trials) if s is not None]
    assert len(found) >= 4
    assert np.abs(of(found, "beta_z")).max() < 5
    assert 0.85 < covered(of(found, "block_z")) < 0.995
    assert len(of(found, "block_z")) > 150
    assert 0.8 < np.median([s.rho for s in found]) < 1.1


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("motion", "duration_s", "plants"), [("rich", 15, 1000), ("sweep", 20, 120)]
)
def test_intervals(motion: str, duration_s: float, plants: int) -> None:
    trials = [Trial(FIRST_SEED + k, motion, duration_s) for k in range(plants)]
    found = list(scores(trials))
    beta, blocks = of(found, "beta_z"), of(found, "block_z")
    basis = f"{len(found)} plants, {motion}, {duration_s:g} s"
    leave(
        f"95 % interval of beta covers, {motion}",
        f"{100 * covered(beta):.1f} %",
        "93 to 97 %",
        basis,
    )
    leave(
        f"95 % interval of valid blocks covers, {motion}",
        f"{100 * covered(blocks):.1f} %",
        "93 to 97 %",
        f"{basis}, {len(blocks)} blocks",
    )
    error = np.abs(of(found, "beta_error"))
    leave(
        f"error of beta, {motion}",
        f"median {100 * np.median(error):.2f} %, 95 % below {100 * np.quantile(error, 0.95):.2f} %",
        "",
        basis,
    )
    flow = np.abs(of(found, "block_error"))
    leave(
        f"error of the mean flow of valid blocks, {motion}",
        f"mean {100 * flow.mean():.3f} %, 99 % below {100 * np.quantile(flow, 0.99):.2f} %",
        "",
        f"{basis}, shares of the largest flow",
    )
    assert 0.93 <= covered(beta) <= 0.97
    assert 0.93 <= covered(blocks) <= 0.97


@pytest.mark.campaign
@pytest.mark.parametrize("p_noise_pa", [5e3, 10e3, 20e3])
def test_bias_of_theta_beta(p_noise_pa: float) -> None:
    """|bias| at most 2 % at 10 kPa where it is identifiable (the steps of the rich motion)."""
    found = list(scores(Trial(3000 + k, "rich", 15, p_noise_pa) for k in range(40)))
    theta = 1 / (1 + of(found, "beta_error")) - 1
    sd = theta.std() / np.sqrt(len(theta))
    leave(
        f"bias of theta_beta at {p_noise_pa / 1e3:g} kPa of pressure noise",
        f"{100 * theta.mean():+.2f} +- {100 * sd:.2f} %",
        "2 % at 10 kPa",
        f"{len(found)} plants, rich, 15 s",
    )
    assert abs(theta.mean()) < 0.02
