"""What a method is given, what it may answer, and what only the simulator knows.

A method is an object with `name()` and `learn(train) -> Learned`; what it has learned predicts, for
a record of other motion, without looking at how its outputs go on:

    valves     test signals (n, 7)    ->  pressure rates dP/dt (n, chambers), Pa/s
    equations  test inputs (n, m)     ->  outputs of the free run (n, p)

Everything else that it may answer is optional: a map, a bulk modulus, deviations, and names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from rtid.errors import RtidError
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.project.plant_file import PlantFile

Names = tuple[frozenset[str], ...]
NOTHING: Names = ()
UNKNOWN: Names = (frozenset({"unknown"}),)
Flow = Callable[[str, ArrayLike, ArrayLike], FloatArray]


class NotForThisError(RtidError):
    """A record of a kind that a method is not made for."""


@dataclass(frozen=True)
class Record:
    """Samples beside what their user declares.

    declared: a `Machine`, or the file of a plant by equations; t_s (n,); values (n, signals):
    columns as `Machine.signals`, SI, or the plant's inputs, then its outputs (NaN where they are
    to be predicted).
    """

    declared: Machine | PlantFile
    t_s: FloatArray
    values: FloatArray = field(repr=False)

    @property
    def machine(self) -> Machine:
        """The declared machine; NotForThisError for a plant by equations."""
        if not isinstance(self.declared, Machine):
            raise NotForThisError("a plant by equations", "a method for valves cannot take it")
        return self.declared

    @property
    def plant_file(self) -> PlantFile:
        """The declared equations; NotForThisError for a machine with valves."""
        if isinstance(self.declared, Machine):
            raise NotForThisError("a machine with valves", "a method for equations cannot take it")
        return self.declared

    @property
    def chunk(self) -> FloatArray:
        """[t_s, flags, values...] (n, 2 + signals), as rtid's kernels take it; one whole record."""
        flags = np.ones(len(self.t_s))
        flags[0] = 3.0
        return np.column_stack([self.t_s, flags, self.values])

    def column(self, name: str) -> FloatArray:
        """One signal of a machine (n,), SI."""
        return np.ascontiguousarray(self.values[:, self.machine.column(name)])


@dataclass(frozen=True)
class Learned:
    """What a method has learned; None where it has no answer.

    flow, flow_sd: Q(edge, w_v, dp_pa) and its standard deviation, m3/s; beta_pa, beta_sd_pa
    (chambers,); missing: sets of effects that cannot be told apart, NOTHING, or UNKNOWN.
    """

    predict: Callable[[Record], FloatArray]
    flow: Flow | None = None
    flow_sd: Flow | None = None
    beta_pa: FloatArray | None = None
    beta_sd_pa: FloatArray | None = None
    missing: Names | None = None


class Method(Protocol):
    """What a stranger's file has to hold."""

    def name(self) -> str:
        """Its row in the tables."""

    def learn(self, train: Record) -> Learned:
        """Learn from one record; NotForThisError for a kind that it is not made for."""


@dataclass(frozen=True)
class Truth:
    """What no method sees.

    target: what `predict` is held against, (n, c); scale (n, c): what one unit of it counts, so
    that an error is a share of the rms flow (or of the output's spread) once averaged over
    `mean_over` samples; flow: the true map, points: (w, dp) that the training record visits, by
    edge; beta_pa; effect: what is hidden, as the catalogue calls it, "" for none, OUTSIDE for what
    no catalogue knows.
    """

    target: FloatArray = field(repr=False)
    scale: FloatArray = field(repr=False)
    mean_over: int = 1
    flow: Flow | None = None
    points: dict[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict, repr=False)
    beta_pa: float = np.nan
    effect: str = ""


OUTSIDE = "(outside)"


@dataclass(frozen=True)
class Case:
    """One record with its truth; for_all: every method takes it, not those alone that name."""

    name: str
    simulator: str
    law: str
    motion: str
    hidden: str
    level: str
    train: Record
    test: Record
    truth: Truth
    for_all: bool = False


@dataclass(frozen=True)
class Wish:
    """A case that is not drawn yet: what a plant's file yields for a seed."""

    name: str
    draw: Callable[[int], Case | None]


class Plant(Protocol):
    """A module of `plants`: which cases it has at a size, SMALL, MIDDLE or LARGE."""

    def wishes(self, size: str) -> Iterator[Wish]:
        """The cases, drawn one by one from a seed."""


SMALL, MIDDLE, LARGE = SIZES = "small", "middle", "large"
