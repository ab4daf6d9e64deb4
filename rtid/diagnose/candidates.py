"""Candidate columns: what one unit of each effect would add to the chambers, per interval.

Every column is a volume in m3 over each interval and per chamber, for a coefficient of 1 in the
effect's SI unit, on the right-hand side of (14).  Those of storage effects also have an *echo*: the
same column of the pressures' noise alone, by which errors in variables are taken out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from rtid.diagnose.view import View
from rtid.model import FloatArray

LAMINAR, TURBULENT = "m3/s/Pa", "m3/s/sqrt(Pa)"
STEPS = (-1.0, -0.5, 0.5, 1.0)  # about a shape, in steps of its axes
SLOPE_STEP = 0.05  # the same, for derivatives

Volumes = dict[int, FloatArray]  # chamber -> (n - 1,) m3
Shape = tuple[float, ...]


@dataclass(frozen=True)
class Candidate:
    """One column: effect, where it sits, the parameter that its coefficient is, and its bounds.

    sign: +1 where only positive coefficients are possible, 0 either; largest: of the coefficient,
    SI; shape: the values of the nonlinear parameters that the column was made with.
    """

    effect: str
    where: str
    parameter: str
    unit: str
    largest: float
    sign: int = 1
    shape: Shape = ()
    shape_names: tuple[str, ...] = ()
    shape_units: tuple[str, ...] = ()

    @property
    def key(self) -> tuple[str, str]:
        """Candidates that differ in shape alone are one cause."""
        return self.effect, self.where

    def is_possible(self, value: float) -> bool:
        """True for a physically possible sign and size."""
        return abs(value) <= self.largest and (self.sign == 0 or value * self.sign > 0)


@dataclass(frozen=True)
class Cause:
    """An effect at one place: its column as a function of the shape.

    axes: values of every nonlinear parameter to begin with; all combinations of those of the first
    `banked` axes are scored, the others begin at their first value.  offered = False: the record
    cannot hold the effect, but what another one taught counts.
    """

    candidate: Candidate
    column: Callable[[Shape], Volumes]
    axes: tuple[Shape, ...] = ()
    banked: int = 1
    offered: bool = True

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Shapes that are scored; one, and empty, without nonlinear parameters."""
        axes = [axis if k < self.banked else axis[:1] for k, axis in enumerate(self.axes)]
        return tuple(product(*axes))

    def at(self, shape: Shape) -> Candidate:
        """The candidate with this shape."""
        return replace(self.candidate, shape=shape)

    def makes(self, candidate: Candidate) -> bool:
        """True for a candidate of this cause, whatever its shape."""
        return replace(candidate, shape=()) == self.candidate

    def spacing(self, k: int) -> float:
        """Distance of the values of axis k to begin with."""
        return float(np.max(np.diff(self.axes[k]))) if len(self.axes[k]) > 1 else 0.0

    def bounds(self, k: int) -> tuple[float, float]:
        """Between which nonlinear parameter k may be: positive, and not far beyond its axis."""
        axis, spacing = self.axes[k], self.spacing(k)
        return max(axis[0] - spacing, min(axis[0], 0.0)), axis[-1] + spacing

    def slope(self, shape: Shape, k: int) -> Volumes:
        """Derivative of the column with respect to nonlinear parameter k."""
        return self.slope_of(self.column, shape, k)

    def slope_of(self, make: Callable[[Shape], Volumes], shape: Shape, k: int) -> Volumes:
        """Derivative of anything made with a shape, by differences."""
        step = SLOPE_STEP * self.spacing(k)
        above, below = ((*shape[:k], shape[k] + s, *shape[k + 1 :]) for s in (step, -step))
        low = make(below)
        return {c: (high - low[c]) / (2.0 * step) for c, high in make(above).items()}

    def about(self, shape: Shape, step: float) -> tuple[Shape, ...]:
        """Shapes that differ from one in one parameter by up to `step` of its axis' spacing."""
        found = []
        for k in range(len(self.axes)):
            for part in STEPS:
                value = float(np.clip(shape[k] + part * step * self.spacing(k), *self.bounds(k)))
                if value != shape[k]:
                    found.append((*shape[:k], value, *shape[k + 1 :]))
        return tuple(dict.fromkeys(found))


def fixed(candidate: Candidate, make: Callable[..., Volumes], *arguments: Any) -> Cause:
    """A cause without shape, its column being make(*arguments)."""
    return Cause(candidate, lambda _: make(*arguments))


def places(view: View) -> dict[str, tuple[int, ...]]:
    """The chambers by name, and both."""
    found = {chamber.name: (c,) for c, chamber in enumerate(view.model.chambers)}
    return found | ({"both": (0, 1)} if len(found) == 2 else {})


@dataclass
class Columns:
    """Candidates and columns, in the order in which they were added.

    condense: what a series per interval (n - 1,) adds to the rows (rows,), which is all that is
    kept, and only until it is `released`.
    """

    condense: Callable[[FloatArray], FloatArray]
    candidates: list[Candidate] = field(default_factory=list)
    echo_of: dict[int, int] = field(default_factory=dict)  # column -> its echo's column
    n: int = 0
    _columns: list[Volumes] = field(default_factory=list)

    def add(self, volumes: Volumes) -> int:
        """Another column; its number."""
        self._columns.append({c: self.condense(series) for c, series in volumes.items()})
        self.n += 1
        return self.n - 1

    def offer(self, candidate: Candidate, volumes: Volumes) -> None:
        """Another candidate; candidates come before echoes."""
        self.candidates.append(candidate)
        self.add(volumes)

    def released(self) -> list[Volumes]:
        """What all columns add to the rows, chamber -> (rows,); kept no longer."""
        columns, self._columns = self._columns, []
        self.condense = np.asarray  # which held the rows
        return columns
