"""A chamber that is softer than its oil: what is stored there, told by the other chamber.

Where V(x) moves little, a dead volume, a hose's wall and a slow line are a part of the modulus: the
rows of their own chamber hardly show them, and no map is wrong.  But one oil has one modulus, and
what chamber b has beyond that of a is stored beside it,

    V_d = (c_b / c_a - 1) V_b,    c the compliances (1 / beta), V_b the volume over the record,

with the interval of the moduli in which what the blocks miss is counted.  On 20 clean sweeps of ten
laws the moduli were at most 0.7 of those deviations apart; a dead volume of 0.48 L was 10.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.diagnose.excuse import counted
from rtid.diagnose.fit import Fit
from rtid.diagnose.regression import LIMIT_SD
from rtid.effects.laws.lines import lines_at, stores_at
from rtid.estimator.misfit import can_be_explained
from rtid.plain import FloatArray, Key

LEAST = 0.05  # of the modulus: an area 3 % too wide moves them apart by 2 to 4 %


@dataclass(frozen=True)
class Softer:
    """The softer chamber, by which share of its oil's compliance, and what it holds more, m3.

    share_sd, volume_sd_m3: standard deviations, what the blocks miss counted.
    """

    chamber: str
    share: float
    share_sd: float
    volume_m3: float

    @property
    def volume_sd_m3(self) -> float:
        """Of the volume."""
        return self.volume_m3 * self.share_sd / self.share

    @property
    def causes(self) -> tuple[Key, ...]:
        """What it may be, the plainest first: one record does not tell them apart."""
        return (*sorted(stores_at(self.chamber)), *sorted(lines_at(self.chamber)))

    @property
    def remedy(self) -> str:
        """What its rows do not size, its modulus does."""
        return (
            f"declare {1e3 * self.volume_m3:.3g} L more dead volume in [chambers.{self.chamber}], "
            "by its modulus; its rows, which size what is added, hardly show it"
        )


def softer(fit: Fit) -> Softer | None:
    """The chamber of two that is clearly softer than the other; None where none is."""
    if len(fit.model.chambers) != 2 or not can_be_explained(fit.sent):
        return None
    at = int(np.argmax(fit.compliance))
    if fit.compliance[1 - at] <= 0.0 or not _is_clear(*_share(fit.compliance, fit.compliance_cov)):
        return None
    share, sd = _share(fit.compliance, counted(fit))
    if not _is_clear(share, sd):
        return None
    volume = share * float(np.mean(fit.view.volume(at)))
    return Softer(fit.model.chambers[at].name, share, sd, volume)


def _share(compliance: FloatArray, cov: FloatArray) -> tuple[float, float]:
    """What the larger of two compliances (2,) has beyond the other, as a share, and its deviation.

    cov: theirs (2, 2).
    """
    at = int(np.argmax(compliance))
    soft, stiff = float(compliance[at]), float(compliance[1 - at])
    variance = cov[at, at] / soft**2 + cov[1 - at, 1 - at] / stiff**2
    variance -= 2.0 * cov[0, 1] / (soft * stiff)
    return soft / stiff - 1.0, soft / stiff * float(np.sqrt(max(0.0, variance)))


def _is_clear(share: float, sd: float) -> bool:
    return share > max(LEAST, LIMIT_SD * sd)
