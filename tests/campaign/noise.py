"""What pressure noise does to theta_beta = 1 / beta, over random machines.

theta_beta is what the regression estimates, so its interval is the symmetric one:

    z = (theta - true) / sd,   identifiable where sd / theta <= 5 %
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rtid.plain import FloatArray
from tests.campaign.plants import Score

IDENTIFIABLE = 0.05  # relative standard deviation
Z95 = 1.96


@dataclass(frozen=True)
class Bias:
    """One row per machine and chamber: relative error of theta_beta, z, relative sd (n,)."""

    error: FloatArray
    z: FloatArray
    sd: FloatArray

    @property
    def identifiable(self) -> Bias:
        """Those whose interval is narrow."""
        return self._where(self.sd <= IDENTIFIABLE)

    @property
    def unidentifiable(self) -> Bias:
        """The others."""
        return self._where(self.sd > IDENTIFIABLE)

    def _where(self, kept: np.ndarray) -> Bias:
        return Bias(self.error[kept], self.z[kept], self.sd[kept])

    def __len__(self) -> int:
        return len(self.error)

    @property
    def covered(self) -> float:
        """Share of the 95 % intervals that hold the truth; NaN where there are none."""
        return float(np.mean(np.abs(self.z) < Z95)) if len(self) else np.nan

    def __str__(self) -> str:
        if not len(self):
            return "none"
        middle, mean = 100 * np.median(self.error), 100 * self.error.mean()
        share = 100 * self.covered
        return f"median {middle:+.2f} %, mean {mean:+.2f} %, covers {share:.0f} % of {len(self)}"


def bias(result: Iterable[Score]) -> Bias:
    """From errors of beta to those of theta_beta = 1 / beta, sd_theta = sd_beta / beta^2."""
    scores = list(result)
    error = np.concatenate([s.beta_error for s in scores])
    z = np.concatenate([s.beta_z for s in scores])
    return Bias(1 / (1 + error) - 1, -z * (1 + error), np.abs(error / (z * (1 + error))))
