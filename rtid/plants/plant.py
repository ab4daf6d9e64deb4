"""A plant by its equations, x' = f(x, u, p), y = g(x, u, p), with states that nobody measures.

Right sides are trees of `rtid.effects.tree` over the names of states, inputs and parameters.  An
input acts as `acts` says, e.g. behind a dead zone; it may come late.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.effects.tree import ONE, ZERO, Node
from rtid.errors import RtidError
from rtid.plain import BoolArray, FloatArray, IntArray

ANY = "any"
ZERO_ORDER, FIRST_ORDER = "zero", "first"
GAP_STEPS = 10.0  # a step longer than so many usual ones ends a part of the record
MOST_PARTS = 16  # each costs initial values of its own; a record with more is cut at its widest


class PlantError(RtidError):
    """A plant, an effect or a record that cannot be used."""

    exit_code = 2


@dataclass(frozen=True)
class PlantParameter:
    """A number that the fit may change between low and high."""

    name: str
    start: float
    low: float
    high: float
    unit: str = ""


@dataclass(frozen=True)
class PlantState:
    """One state: name' = rate.  start, low, high: of its initial value.

    inertia: what a force on it is divided by; ambient: what it leaks or cools towards; follows:
    the input whose first value it starts from, "" if its initial value is estimated.
    """

    name: str
    rate: Node
    start: float = 0.0
    low: float = -np.inf
    high: float = np.inf
    unit: str = ""
    quantity: str = ANY
    inertia: Node = ONE
    ambient: Node = ZERO
    follows: str = ""


@dataclass(frozen=True)
class Input:
    """One input as it is recorded, and what the equations see of it.

    acts: over the input's own name, parameters and states.  delay: the name of a parameter.
    """

    name: str
    acts: Node
    hold: str = ZERO_ORDER
    unit: str = ""
    delay: str = ""


@dataclass(frozen=True)
class Output:
    """One measured output; noise (1 sigma) is NaN where it is not known; play: a parameter."""

    name: str
    value: Node
    unit: str = ""
    noise: float = np.nan
    play: str = ""


@dataclass(frozen=True)
class Plant:
    """A plant; its names are unique over states, inputs and parameters.

    parts: how many parts of a record it runs over, each from initial values of its own.
    """

    name: str
    states: tuple[PlantState, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[PlantParameter, ...]
    parts: int = 1

    def state(self, name: str) -> PlantState:
        """The state of that name."""
        return next(s for s in self.states if s.name == name)

    def with_state(self, changed: PlantState) -> Plant:
        """The plant with a state replaced, or appended if it is new."""
        known = changed.name in {s.name for s in self.states}
        states = tuple(changed if s.name == changed.name else s for s in self.states)
        return replace(self, states=states if known else (*states, changed))

    def with_input(self, changed: Input) -> Plant:
        """The plant with an input replaced."""
        inputs = tuple(changed if i.name == changed.name else i for i in self.inputs)
        return replace(self, inputs=inputs)

    def with_output(self, changed: Output) -> Plant:
        """The plant with an output replaced."""
        outputs = tuple(changed if o.name == changed.name else o for o in self.outputs)
        return replace(self, outputs=outputs)

    @property
    def unknowns(self) -> tuple[PlantParameter, ...]:
        """What a fit estimates: the parameters, then the states' initial values part by part."""
        initial = tuple(
            PlantParameter(f"{s.name}(0){_of_part(k)}", s.start, s.low, s.high, s.unit)
            for k in range(self.parts)
            for s in self.states
            if not s.follows
        )
        return self.parameters + initial

    @property
    def initial_values(self) -> int:
        """How many initial values a fit estimates for each part of a record."""
        return sum(not s.follows for s in self.states)


def _of_part(k: int) -> str:
    return f" of part {k + 1}" if k else ""


LARGEST = 1e30  # of any number in a record: the sum of its squares must stay finite


@dataclass(frozen=True)
class PlantRecord:
    """Instants t_s (n,), inputs u (n, inputs) and outputs y (n, outputs; NaN: not measured)."""

    t_s: FloatArray
    u: FloatArray
    y: FloatArray

    def __post_init__(self) -> None:
        for what, values in (("time", self.t_s), ("an input", self.u), ("an output", self.y)):
            if (np.abs(values) > LARGEST).any():
                remedy = "check the columns; leave a value that is not known empty"
                raise PlantError(f"{what} holds numbers beyond {LARGEST:g}", remedy)
        if len(self.t_s) < 2 or not (np.diff(self.t_s) > 0).all():
            raise PlantError("the time does not grow from row to row", "sort the table by time")
        if not np.isfinite(self.u).all():
            row = int(np.argmin(np.isfinite(self.u).all(axis=1)))
            remedy = "fill it: an input must be known throughout"
            raise PlantError(f"an input is missing in row {row} of the record", remedy)
        if not np.isfinite(self.y).any(axis=0).all():
            raise PlantError("an output was never measured", "check the column of each output")

    @property
    def starts(self) -> IntArray:
        """Rows (parts,) at which a part begins: the first, and those behind a gap in time."""
        steps = np.diff(self.t_s)
        gaps = np.flatnonzero(steps > GAP_STEPS * np.median(steps))
        widest = gaps[np.argsort(-steps[gaps], kind="stable")[: MOST_PARTS - 1]]
        return np.concatenate([[0], np.sort(widest) + 1])

    @property
    def used(self) -> BoolArray:
        """Which outputs were measured, (n, outputs)."""
        return np.isfinite(self.y)
