"""A plant by its equations, x' = f(x, u, p), y = g(x, u, p), with states that nobody measures.

Right sides are trees of `rtid.effects.tree` over the names of states, inputs and parameters.  An
input acts as `acts` says, e.g. behind a dead zone; it may come late.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtid.effects.tree import NAME, ONE, ZERO, FloatArray, Node
from rtid.errors import RtidError

ANY = "any"
ZERO_ORDER, FIRST_ORDER = "zero", "first"


class PlantError(RtidError):
    """A plant, an effect or a record that cannot be used."""

    exit_code = 2


@dataclass(frozen=True)
class Parameter:
    """A number that the fit may change between low and high."""

    name: str
    start: float
    low: float
    high: float
    unit: str = ""


@dataclass(frozen=True)
class State:
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
    """A plant; its names are unique over states, inputs and parameters."""

    name: str
    states: tuple[State, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[Parameter, ...]

    def state(self, name: str) -> State:
        """The state of that name."""
        return next(s for s in self.states if s.name == name)

    def with_state(self, changed: State) -> Plant:
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
    def unknowns(self) -> tuple[Parameter, ...]:
        """What a fit estimates: the parameters, then the initial values of the states."""
        initial = tuple(
            Parameter(f"{s.name}(0)", s.start, s.low, s.high, s.unit)
            for s in self.states
            if not s.follows
        )
        return self.parameters + initial


@dataclass(frozen=True)
class Record:
    """Instants t_s (n,), inputs u (n, inputs) and outputs y (n, outputs; NaN: not measured)."""

    t_s: FloatArray
    u: FloatArray
    y: FloatArray

    def __post_init__(self) -> None:
        if len(self.t_s) < 2 or not (np.diff(self.t_s) > 0).all():
            raise PlantError("the time does not grow from row to row", "sort the table by time")
        if not np.isfinite(self.u).all():
            row = int(np.argmin(np.isfinite(self.u).all(axis=1)))
            remedy = "fill it: an input must be known throughout"
            raise PlantError(f"an input is missing in row {row} of the record", remedy)
        if not np.isfinite(self.y).any(axis=0).all():
            raise PlantError("an output was never measured", "check the column of each output")

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which outputs were measured, (n, outputs)."""
        return np.isfinite(self.y)


def named(name: str) -> Node:
    """The tree of a name."""
    return Node(NAME, name=name)


def substituted(node: Node, by: Mapping[str, Node]) -> Node:
    """The tree with names replaced by trees."""
    if node.op == NAME:
        return by.get(node.name, node)
    args = tuple(substituted(arg, by) for arg in node.args)
    if node.op == "-" and args[1] == ZERO:
        return args[0]
    return replace(node, args=args)
