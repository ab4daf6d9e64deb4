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

from rtid.effects.law import LENGTH, Placed, Shape, Volumes, fitted_names
from rtid.effects.page import SPREAD, Effect, Parameter, effect
from rtid.effects.record_view import RecordView

STEPS = (-1.0, -0.5, 0.5, 1.0)  # about a shape, in steps of its axes
SLOPE_STEP = 0.05  # the same, for derivatives
WHOLE = "whole"  # the coefficient of a cause that its shape alone describes: it is 1


@dataclass(frozen=True)
class Candidate:
    """One column: effect, where it sits, the parameter that its coefficient is, and its bounds.

    sign: +1 where only positive coefficients are possible, 0 either; largest: of the coefficient,
    SI; shape: the values of the nonlinear parameters that the column was made with; page: of the
    effect, where the catalogue does not have it.
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
    page: Effect | None = field(default=None, compare=False, repr=False)

    @property
    def law(self) -> Effect:
        """The effect that it is a column of."""
        return self.page or effect(self.effect)

    @property
    def is_whole(self) -> bool:
        """True where the shape says all of it: its first number is the size."""
        return self.parameter == WHOLE

    @property
    def n_parameters(self) -> int:
        """Numbers that describe it."""
        return len(self.shape) + (not self.is_whole)

    @property
    def key(self) -> tuple[str, str]:
        """Candidates that differ in shape alone are one cause."""
        return self.effect, self.where

    def page_of(self, k: int) -> Parameter | None:
        """What its page says of nonlinear parameter k, whose name may say more than the page's."""
        name = self.shape_names[k]
        return next((p for p in self.law.parameters if f"{name}_".startswith(f"{p.name}_")), None)

    def is_possible(self, value: float) -> bool:
        """True for a physically possible sign and size."""
        return abs(value) <= self.largest and (self.sign == 0 or value * self.sign > 0)


def of_page(
    page: Effect, where: str, parameter: str = "", shape: tuple[str, ...] = (), called: str = ""
) -> Candidate:
    """A column of an effect: parameter (the first unless named) with its unit, sign and range.

    shape: names of the nonlinear parameters; called: what the diagnosis calls the parameter where
    it has several columns of it.
    """
    pages = {p.name: p for p in page.parameters}
    first = pages[parameter] if parameter else page.size
    return Candidate(
        page.name, where, called or first.name, first.unit, max(abs(first.low), first.high),
        first.sign, shape_names=shape, shape_units=tuple(pages[s].unit for s in shape), page=page,
    )  # fmt: skip


@dataclass(frozen=True)
class Cause:
    """An effect at one place: its column as a function of the shape.

    axes: values of every nonlinear parameter to begin with; all combinations of those of the first
    `banked` axes are scored, the others begin at their first value.  offered = False: the record
    cannot hold the effect, but what another one taught counts.  ends: between which values the
    first of the axes may be, where that is not a spacing beyond them.
    """

    candidate: Candidate
    column: Callable[[Shape], Volumes]
    axes: tuple[Shape, ...] = ()
    banked: int = 1
    offered: bool = True
    ends: tuple[tuple[float, float], ...] = ()

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Shapes that are scored; one, and empty, without nonlinear parameters."""
        axes = [axis if k < self.banked else axis[:1] for k, axis in enumerate(self.axes)]
        return tuple(product(*axes))

    def at(self, shape: Shape) -> Candidate:
        """The candidate with this shape."""
        return replace(self.candidate, shape=shape)

    def makes(self, candidate: Candidate) -> bool:
        """True for a candidate of this cause, whatever its shape, and of a machine of any size."""
        return replace(candidate, shape=(), largest=self.candidate.largest) == self.candidate

    def spacing(self, k: int) -> float:
        """Distance of the values of axis k to begin with."""
        return float(np.max(np.diff(self.axes[k]))) if len(self.axes[k]) > 1 else 0.0

    def bounds(self, k: int) -> tuple[float, float]:
        """Between which nonlinear parameter k may be: as its page says, not far beyond its axis."""
        axis, spacing = self.axes[k], self.spacing(k)
        page = self.candidate.page_of(k)
        low, high = (page.low, page.high) if page else (min(axis[0], 0.0), np.inf)
        known = k < len(self.ends)
        least, most = self.ends[k] if known else (axis[0] - spacing, axis[-1] + spacing)
        return max(least, low), min(most, high)

    def slope(self, shape: Shape, k: int) -> Volumes:
        """Derivative of the column with respect to nonlinear parameter k."""
        return self.slope_of(self.column, shape, k)

    def slope_of(self, make: Callable[[Shape], Volumes], shape: Shape, k: int) -> Volumes:
        """Derivative of anything made with a shape, by differences within the bounds.

        Beyond them nothing need exist: with a negative volume a line's oil explodes.
        """
        step = SLOPE_STEP * self.spacing(k)
        least, most = self.bounds(k)
        ends = max(shape[k] - step, least), min(shape[k] + step, most)
        below, above = ((*shape[:k], end, *shape[k + 1 :]) for end in ends)
        low = make(below)
        return {c: (high - low[c]) / (ends[1] - ends[0]) for c, high in make(above).items()}

    def about(self, shape: Shape, step: float) -> tuple[Shape, ...]:
        """Shapes that differ from one in one parameter by up to `step` of its axis' spacing."""
        grid = []
        for k in range(len(self.axes)):
            for part in STEPS:
                value = float(np.clip(shape[k] + part * step * self.spacing(k), *self.bounds(k)))
                if value != shape[k]:
                    grid.append((*shape[:k], value, *shape[k + 1 :]))
        return tuple(dict.fromkeys(grid))


def fixed(candidate: Candidate, make: Callable[..., Volumes], *arguments: Any) -> Cause:
    """A cause without shape, its column being make(*arguments)."""
    return Cause(candidate, lambda _: make(*arguments))


def by_equation(view: RecordView, placed: Placed) -> Cause:
    """The cause that an equation describes at one place."""
    page, shapes = placed.effect, placed.effect.shapes
    axes = tuple(_axis(view, p, placed) for p in shapes)
    candidate = of_page(page, placed.where, shape=tuple(p.name for p in shapes))
    wide = all(axis[-1] - axis[0] > p.least for axis, p in zip(axes, shapes, strict=True) if p.over)
    is_timed = not view.model.joined or LENGTH not in fitted_names(page)
    return Cause(candidate, lambda s: placed.volumes(view, s), axes, len(axes), wide and is_timed)


def _axis(view: RecordView, p: Parameter, placed: Placed) -> Shape:
    """Values of a nonlinear parameter to begin with."""
    if p.quantiles:
        pressures = [np.quantile(view.pressure(c), p.quantiles) for c, _ in placed.lines]
        seen = np.clip(np.concatenate(pressures), p.low, p.high)
        return tuple(sorted({*p.start, *seen.tolist()}))
    if p.over:
        seen = view.seen.value(p.over)
        low, high = float(seen.min()), float(seen.max())
        shares = np.clip((high - low) * np.array(p.shares), p.low, p.high)
        return tuple((shares if p.shares else np.linspace(low, high, p.count)).tolist())
    if p.start:
        return p.start
    spread = np.geomspace if p.low > 0 else np.linspace
    return tuple(float(v) for v in spread(p.low, p.high, SPREAD + 2)[1:-1])


def _taken_no_more(_volumes: Volumes, _is_aside: bool) -> None:
    """In the place of what took a column: a function of the module, which a pickle takes."""


@dataclass
class Columns:
    """Candidates and columns, in the order in which they were added.

    take: is given each of them, a record long, as it comes, and whether it stands aside: as what is
    scored by itself, and not beside the others that do.
    """

    take: Callable[[Volumes, bool], object]
    candidates: list[Candidate] = field(default_factory=list)
    echo_of: dict[int, int] = field(default_factory=dict)  # column -> its echo's column
    n: int = 0
    n_beside: int = 0  # candidates that do not stand aside: the first ones

    def add(self, volumes: Volumes, is_aside: bool = False) -> int:
        """Another column; its number."""
        self.take(volumes, is_aside)
        self.n += 1
        return self.n - 1

    def offer(self, candidate: Candidate, volumes: Volumes, is_aside: bool = True) -> None:
        """Another candidate; candidates come before echoes."""
        self.candidates.append(candidate)
        self.n_beside += not is_aside
        self.add(volumes, is_aside)

    def ended(self) -> Columns:
        """The same, let go of what took them, which holds the rows."""
        return replace(self, take=_taken_no_more)
