"""Effects on board that the kernels cannot compute: their flow is taken sample by sample.

What an effect has let flow since the start, per unit of its size, is one more signal E behind those
of the bus, and its rate a shared term of (14), as in `rtid.effects.extra`,

    extra flow = theta dE/dt,   E_k+1 = E_k + mean flow over the interval * its length.

An interval is looked at alone, by its two ends: the result does not depend on how samples arrive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.effects.column import Candidate
from rtid.effects.extra import VOLUME
from rtid.effects.law import LawLine, Placed, Values
from rtid.effects.motions import rates
from rtid.effects.page import FUNCTION, EffectError
from rtid.effects.record_view import RecordView
from rtid.effects.terms import placed_of, without_factor
from rtid.effects.tree import Node
from rtid.model import VELOCITY, Machine, Signal, Term
from rtid.plain import FloatArray


@dataclass(frozen=True)
class LiveFlow:
    """A flow that is evaluated beside the kernels.

    model: the machine as the bus tells of it; placed: the effect at its place; node: the flow for a
    coefficient of 1; signs: the chambers that it enters and leaves; size: the coefficient; shape:
    the nonlinear parameters, as its function takes them; stored: what the flow is the rate of,
    times the node.
    """

    model: Machine
    placed: Placed
    node: Node
    signs: tuple[tuple[str, int], ...]
    size: float
    shape: tuple[tuple[str, float], ...] = ()
    stored: Node | None = None

    @property
    def name(self) -> str:
        """Of its signal and of its term."""
        chambers = "".join(name for name, _ in self.signs)
        return f"{self.placed.effect.name} {self.placed.where} {chambers}"

    @property
    def key(self) -> tuple[object, ...]:
        """What makes it one of a kind."""
        return self.placed.effect.equation, self.size, self.shape

    @property
    def signal(self) -> Signal:
        """What has flowed since the start, m3."""
        return Signal(self.name, VOLUME, "m3")

    @property
    def term(self) -> Term:
        """Its rate, for theta = 1."""
        return Term(self.name, ((self.name, -1.0),), self.signs, 1.0, rate=True)

    def volumes(self, chunk: FloatArray) -> FloatArray:
        """What flows over each interval of a record (n - 1,), m3; nothing where it is not finite.

        Signals beyond what the gates let through count as their limits.
        """
        low, high = (np.array([getattr(s, end) for s in self.model.signals]) for end in ENDS)
        inside = np.hstack([chunk[:, :2], np.clip(chunk[:, 2:], low, high)])
        in_python = self.placed.effect.function is not None
        step = 1 if in_python else max(1, len(inside) - 1)
        pieces = [self._volume(inside[k : k + step + 1]) for k in range(0, len(inside) - 1, step)]
        return np.concatenate([np.zeros(0), *pieces])

    def _volume(self, chunk: FloatArray) -> FloatArray:
        view = RecordView.without_map(self.model, chunk)
        try:
            values = Values(self.placed.effect, view, dict(self.shape))
            volume = self.size * values.volume(LawLine("", self.node, self.stored))
        except EffectError:
            return np.zeros(len(chunk) - 1)
        return np.where(np.isfinite(volume), volume, 0.0)


ENDS = "minimum", "maximum"


def live_flows(
    model: Machine, compliance: FloatArray, effect: Candidate, size: float
) -> tuple[LiveFlow, ...]:
    """The flows of an effect with the coefficient `size`; () where only a record tells of it.

    compliance (chambers,): 1/Pa.
    """
    placed = placed_of(model, compliance, effect)
    if placed is None:
        return ()
    shape = tuple(zip(effect.shape_names, effect.shape, strict=True))
    flows: dict[tuple[float, Node], LiveFlow] = {}
    for c, line in placed.lines:
        factor, node = without_factor(line.outer)
        if line.late or not _is_known(model, line.names, placed):
            return ()
        sign, alike = (1 if factor > 0 else -1), (abs(factor), node)
        made = LiveFlow(_of_bus(model), placed, node, (), size * abs(factor), shape, line.inner)
        known = flows.get(alike, made)
        flows[alike] = replace(known, signs=(*known.signs, (model.chambers[c].name, sign)))
    return tuple(flows.values())


def _of_bus(model: Machine) -> Machine:
    """The machine as its samples come: the integral of a rate that is measured is made of them."""
    if not model.measured:
        return model
    return replace(model, signals=tuple(s for s in model.signals if s.name != model.position))


def _is_known(model: Machine, names: set[str], placed: Placed) -> bool:
    """False for flows of the map, and for a velocity that would have to be made of samples."""
    signals = {s.name for s in model.signals}
    known = signals | {f"{letter}_{c.name}" for c in model.chambers for letter in "VA"} | {"x", "t"}
    known |= rates(model)
    known |= {"v"} if any(s.kind == VELOCITY for s in model.signals) else set()
    known |= {FUNCTION} if placed.effect.function is not None else set()
    return names <= known
