"""The zeros of the pressure sensors: found where valves join them, and what they bend.

Every joint gives one difference of two zeros; least squares over all of them give each zero against
the one that nothing drifts in, the tank's where it is joined:

    apart_ij = b_i - b_j + e_ij + f_ij drop_ij,   var(e_ij) = sd_ij^2,   f_ij in [-1, 1];

the f, of the law of each valve near zero, may conspire: what they make of a zero is their sum.

A zero that is off moves a map along dp, and the residual says nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from rtid.diagnose.consequence import BEND
from rtid.diagnose.fit import Fit
from rtid.diagnose.joined import Joint
from rtid.diagnose.regression import LIMIT_SD
from rtid.diagnose.residual import is_known
from rtid.effects.record_view import RecordView, supply_of, tank_of
from rtid.model import Machine
from rtid.units import UNIFORM

CONTRADICTS = 1e-3  # probability of what the joints leave, below which they contradict each other


@dataclass(frozen=True)
class Zero:
    """What a pressure sensor shows more than another at the same pressure, Pa.

    seconds: of joints that tell; is_confirmed: two ways lead to it, through different sensors, and
    they agree; maps: of one that is off, what it bends: edge and rms over the visits, as a share
    of the largest flow.
    """

    signal: str
    against: str
    apart_pa: float
    std_pa: float
    seconds: float
    is_confirmed: bool
    maps: dict[str, float] = field(default_factory=dict)

    @property
    def is_off(self) -> bool:
        """True where it is clearly not that of the other sensor."""
        return abs(self.apart_pa) > LIMIT_SD * self.std_pa

    @property
    def matters(self) -> bool:
        """True for one that is certainly off, and bends a map by as much as an effect must."""
        bent = max(self.maps.values(), default=0.0)
        return self.is_off and self.is_confirmed and bent >= BEND


def zeros(fit: Fit, joints: tuple[Joint, ...]) -> tuple[Zero, ...]:
    """The zeros that a record tells, each against its group's first: tank, supply, chambers."""
    known = [z for group in _groups(fit.declared, joints) for z in _solved(group, joints)]
    return tuple(_bent(fit, zero) if zero.is_off else zero for zero in known)


def _groups(machine: Machine, joints: tuple[Joint, ...]) -> Iterator[list[str]]:
    """Signals that joints connect, the one that the others are held against first."""
    order = [tank_of(machine), supply_of(machine), *(c.pressure for c in machine.chambers)]
    left = [s for s in order if any(s in (j.source, j.sink) for j in joints)]
    while left:
        group = [left[0]]
        for signal in group:  # which grows meanwhile
            ends = [(j.source, j.sink) for j in joints if signal in (j.source, j.sink)]
            group += [s for s in dict.fromkeys(sum(ends, ())) if s not in group]
        yield group
        left = [s for s in left if s not in group]


def _solved(group: list[str], joints: tuple[Joint, ...]) -> Iterator[Zero]:
    """The zeros of a group against its first; what contradicts itself is known as badly as that."""
    mine = [j for j in joints if j.source in group]
    rows = np.zeros((len(mine), len(group)))
    for row, joint in zip(rows, mine, strict=True):
        row[group.index(joint.source)], row[group.index(joint.sink)] = 1.0, -1.0
    sd, drop, shown = (
        np.array([getattr(j, name) for j in mine]) for name in ("sd_pa", "drop_pa", "apart_pa")
    )
    weights = 1.0 / (sd**2 + drop**2 / UNIFORM**2)
    weighed = rows[:, 1:].T * weights
    gains = np.linalg.solve(weighed @ rows[:, 1:], weighed)
    apart = gains @ shown
    variances = gains**2 @ sd**2 + (np.abs(gains) @ np.abs(drop)) ** 2 / UNIFORM**2
    left = shown - rows[:, 1:] @ apart
    chi2, freedom = float(left**2 @ weights), len(mine) - len(apart)
    agrees = freedom > 0 and by_chance(freedom, chi2) > CONTRADICTS
    spread = float(np.sqrt(max(1.0, chi2 / freedom))) if freedom else 1.0
    for k, signal in enumerate(group[1:]):
        through = [j for j in mine if signal in (j.source, j.sink)]
        partners = {end for j in through for end in (j.source, j.sink)} - {signal}
        seconds = sum(j.end_s - j.begin_s for j in through)
        deviation = spread * float(np.sqrt(variances[k]))
        confirmed = agrees and len(partners) > 1
        yield Zero(signal, group[0], float(apart[k]), deviation, seconds, confirmed)


def by_chance(freedom: int, chi2: float) -> float:
    """How likely a sum of so many squares of unit variance is larger than chi2, 0 to 1."""
    from scipy.special import chdtrc  # noqa: PLC0415 - takes long to import

    return float(chdtrc(freedom, chi2))


def _bent(fit: Fit, zero: Zero) -> Zero:
    """The same with what it bends, edge by edge, over the intervals that both maps know."""
    shifted, column = fit.sent.copy(), 2 + fit.model.column(zero.signal)
    shifted[:, column] -= zero.apart_pa
    view = RecordView.of(fit.model, shifted, fit.weights, fit.map)
    known, bends = is_known(fit.view) & is_known(view), dict[str, float]()
    for i, edge in enumerate(fit.model.edges):
        flow, other = fit.view.flow(i), view.flow(i)
        open_ = known & (flow != 0.0) & (other != 0.0)
        if zero.signal in (edge.source, edge.sink) and open_.any():
            largest = max(float(np.abs(flow[open_]).max()), 1e-300)
            bends[edge.name] = float(np.sqrt(np.mean((flow - other)[open_] ** 2))) / largest
    return replace(zero, maps=bends)
