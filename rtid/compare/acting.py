"""Effects as shared terms of (14): what they add follows the simulated pressures too.

A leak, a seat, a valve that opens at a pressure, air, dead volume, a hose and cavitation are
functions of the signals, the same as their columns in the diagnosis.  Air of any polytropic
exponent is a sum of inverse terms, for s = 1 / kappa < 1

    P^-s = sin(pi s) / pi  int_0^inf c^-s / (P + c) dc   ~   sum of g_k / (P + c_k).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from rtid.diagnose.candidates import Candidate
from rtid.diagnose.causes.storage import ATMOSPHERE_PA, LEAST_PA
from rtid.model import Chamber, FloatArray, Model, Term

MOST_PA = 60e6  # up to which air is described
SHIFTS_PA = (0.0, 5e4, 2.5e5, 1.2e6, 6e6, 3e7, 3e8)  # c_k: the slope within 0.6 % from 0.5 bar on


@dataclass(frozen=True)
class _Made:
    """An effect with its coefficient, at chambers with their pressures; name: of its terms."""

    model: Model
    compliance: FloatArray
    effect: Candidate
    value: float

    @property
    def name(self) -> str:
        return f"{self.effect.effect} {self.effect.where}"

    @property
    def chambers(self) -> list[Chamber]:
        return [c for c in self.model.chambers if self.effect.where in (c.name, "both")]

    @property
    def law(self) -> str:
        return "linear" if self.effect.effect.endswith("laminar") else "root"


def terms_of(
    model: Model, compliance: FloatArray, effect: Candidate, value: float
) -> tuple[Term, ...]:
    """The terms of an effect with the coefficient `value`, each for theta = 1.

    compliance (chambers,): 1/Pa, that a dead volume's column was made with.
    Empty for an effect that is more than a function of the signals at one instant: its flow can
    only be taken from the measured pressures.
    """
    make = MAKERS.get(effect.effect)
    return tuple(make(_Made(model, compliance, effect, value))) if make else ()


def _between(made: _Made) -> Iterator[Term]:
    one, two = made.model.chambers
    drop, into = _drop(one.pressure, two.pressure), ((one.name, -1), (two.name, 1))
    yield Term(made.name, drop, into, made.value, shape=made.law)


def _out(made: _Made) -> Iterator[Term]:
    model = made.model
    chambers = {chamber.pressure for chamber in model.chambers}
    # the signal that `View.tank` reads
    tank = min((e.sink for e in model.edges if e.sink not in chambers), default="")
    for c in made.chambers:
        drop = _drop(c.pressure, tank)
        yield Term(made.name, drop, ((c.name, -1),), made.value, shape=made.law)


def _seat(made: _Made) -> Iterator[Term]:
    model = made.model
    edge = next(e for e in model.edges if e.name == made.effect.where)
    into = tuple((c.name, edge.sign(c)) for c in model.chambers if edge.sign(c))
    yield Term(made.name, _drop(edge.source, edge.sink), into, made.value, shape="root")


def _drop(source: str, sink: str) -> tuple[tuple[str, float], ...]:
    """Pressure drop, as the weights of a term; "" is a pressure of zero."""
    return tuple((name, sign) for name, sign in ((source, 1.0), (sink, -1.0)) if name)


def _opening(made: _Made) -> Iterator[Term]:
    """Out above the opening pressure, or in below it; nothing for a poppet with a state."""
    opening, own_time_s, hysteresis = made.effect.shape
    sign = 1 if made.effect.effect == "relief_valve" else -1
    for c in made.chambers if own_time_s == hysteresis == 0.0 else []:
        weights, into = ((c.pressure, float(sign)),), ((c.name, -sign),)
        yield Term(made.name, weights, into, made.value, -sign * opening, "hinge")


def _soft(made: _Made) -> Iterator[Term]:
    """Dead volume, by the compliance that its column was made with, or a hose."""
    size, names = made.value, [c.name for c in made.model.chambers]
    if made.effect.effect == "extra_dead_volume":
        at = [names.index(c.name) for c in made.chambers]
        size *= float(np.mean(made.compliance[at]))
    for c in made.chambers:
        yield Term(made.name, ((c.pressure, 1.0),), ((c.name, 1),), size, rate=True)


def _vapour(made: _Made) -> Iterator[Term]:
    for c in made.chambers:
        yield Term(
            made.name, ((c.pressure, -1.0),), ((c.name, -1),), made.value, made.effect.shape[0],
            "hinge", rate=True, volume=c.name,
        )  # fmt: skip


def _gas(made: _Made) -> Iterator[Term]:
    """Air; nothing where a declared range lets a pressure reach zero."""
    model, gains = made.model, shares(1.0 / made.effect.shape[0])
    lowest = {s.name: s.minimum for s in model.signals}
    for c in made.chambers if all(lowest[c.pressure] > 0.0 for c in made.chambers) else []:
        for shift, gain in zip(SHIFTS_PA, gains, strict=True):
            if gain > 0.0:
                yield Term(
                    made.name, ((c.pressure, 1.0),), ((c.name, 1),), made.value * gain, shift,
                    "inverse", rate=True, volume=c.name,
                )  # fmt: skip


MAKERS: dict[str, Callable[[_Made], Iterator[Term]]] = {
    "internal_leakage_laminar": _between,
    "internal_leakage_turbulent": _between,
    "external_leakage_laminar": _out,
    "external_leakage_turbulent": _out,
    "valve_seat_leakage": _seat,
    "relief_valve": _opening,
    "makeup_valve": _opening,
    "extra_dead_volume": _soft,
    "hose_compliance": _soft,
    "cavitation": _vapour,
    "entrained_air": _gas,
}


def shares(s: float) -> FloatArray:
    """g (k,), not negative: (p0 / P)^s ~ sum of g / (P + SHIFTS_PA), by its slope in P."""
    p = np.geomspace(LEAST_PA, MOST_PA, 200)
    slope = s / p * (ATMOSPHERE_PA / p) ** s
    columns = 1.0 / (p[:, None] + np.array(SHIFTS_PA)) ** 2 / slope[:, None]
    scale = columns.max(axis=0)
    return np.asarray(nnls(columns / scale, np.ones(len(p)))[0] / scale)
