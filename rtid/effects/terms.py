"""Effects as shared terms of (14): what they add follows the simulated pressures, and runs live.

The kernels know flows k f(z) and what is stored, - k V df(z)/dt, with z a weighted sum of pressures
and the position, and f(z) = z, ssqrt(z), pos(z) or -1 / z.  An effect whose equation is of such a
form at every chamber is made of these terms, whoever has written it.  What is stored as another
function of one pressure, such as air of any polytropic exponent, is a sum of inverse terms,

    - G(P)  ~  sum of g_k / (P + c_k),     by its slope; for (p0 / P)^s with s < 1 exactly
    P^-s = sin(pi s) / pi  int_0^inf c^-s / (P + c) dc.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.effects.column import Candidate
from rtid.effects.expression import Expression
from rtid.effects.law import LawLine, Placed, places_of
from rtid.effects.tree import NAME, NEG, Node, derivative, number
from rtid.model import POSITION, PRESSURE, Machine, Term
from rtid.plain import FloatArray

LEAST_PA, MOST_PA = 5e4, 60e6  # between which a stored gas is described
SHIFTS_PA = (0.0, 5e4, 2.5e5, 1.2e6, 6e6, 3e7, 3e8)  # c_k: the slope within 0.6 % from 0.5 bar on
STRAIGHT = 0.01  # of the slope of what is stored, that may change where it counts as none
DESCRIBED = 0.02  # of the slope of what is stored, that a sum of inverses may be off by
LAWS = {"ssqrt": "root", "pos": "hinge"}


@dataclass(frozen=True)
class _Form:
    """size * f(z): weights by signal and constant of z, f by its name in `Term`."""

    size: float
    weights: tuple[tuple[str, float], ...]
    constant: float
    shape: str


def terms_of(
    model: Machine, compliance: FloatArray, effect: Candidate, value: float
) -> tuple[Term, ...]:
    """The terms of an effect with the coefficient `value`, each for theta = 1.

    compliance (chambers,): 1/Pa, that a dead volume's column was made with.
    Empty for an effect of another form, or one that is more than a function of the signals at one
    instant: its flow can only be taken from the measured pressures.
    """
    placed, terms = placed_of(model, compliance, effect), dict[Term, Term]()
    for c, line in placed.lines if placed else ():
        forms = _forms(model, model.chambers[c].name, line)
        if not forms:
            return ()
        for form, volume in forms:
            sign, scale = (1 if form.size > 0 else -1), value * abs(form.size)
            alike = Term(
                f"{effect.effect} {effect.where}", form.weights, (), scale, form.constant,
                form.shape, rate=line.inner is not None, volume=volume,
            )  # fmt: skip
            known = terms.get(alike, alike)  # one term for a flow from one chamber to another
            terms[alike] = replace(known, signs=(*known.signs, (model.chambers[c].name, sign)))
    return tuple(terms.values())


def placed_of(model: Machine, compliance: FloatArray, effect: Candidate) -> Placed | None:
    """The equation of an effect at its place, nonlinear parameters put in; None where it says less.

    compliance (chambers,): 1/Pa.  A nonlinear parameter that the equation does not use describes a
    state: it must be zero.
    """
    shape = dict(zip(effect.shape_names, effect.shape, strict=True))
    values = {p.symbol: shape.get(p.name, 0.0) for p in effect.law.shapes}
    by = {symbol: number(value) for symbol, value in values.items()}
    for placed in places_of(effect.law, model, compliance):
        if placed.where == effect.where:
            used = {name for _, line in placed.lines for name in line.names}
            if effect.law.function is None and any(
                value for symbol, value in values.items() if symbol not in used
            ):
                return None
            return replace(placed, lines=tuple((c, line.put(by)) for c, line in placed.lines))
    return None


def _forms(model: Machine, chamber: str, line: LawLine) -> list[tuple[_Form, str]]:
    """The forms of one line, each with the chamber whose volume multiplies its rate; else none."""
    if line.inner is None:
        form = _form(model, line.outer)
        return [(form, "")] if form else []
    size, room = without_factor(line.outer)
    volume = chamber if room.names == (f"V_{chamber}",) and room.op == NAME else ""
    if room.names and not volume:
        return []
    form = _form(model, line.inner)
    forms = [form] if form and form.shape != "root" else _of_one_pressure(model, line.inner)
    # a term's rate has a minus of its own: - theta * scale * V df/dt
    return [(replace(f, size=-size * f.size), volume) for f in forms]


def _form(model: Machine, node: Node) -> _Form | None:
    """The node as size * f(z); None where it is nothing of that kind."""
    size, inner = without_factor(node)
    law = LAWS.get(inner.op, "linear")
    weighed = _weights(model, inner.args[0] if inner.op in LAWS else inner)
    return _Form(size, *weighed, law) if weighed and size else None


def without_factor(node: Node) -> tuple[float, Node]:
    """Constant factor of a product, and what it multiplies: 1 where that is all."""
    if not node.names:
        return float(Expression("", node)()), number(1.0)
    if node.op == NEG:
        size, inner = without_factor(node.args[0])
        return -size, inner
    if node.op in ("*", "/") and not node.args[1].names:
        size, inner = without_factor(node.args[0])
        factor = float(Expression("", node.args[1])())
        return (size * factor if node.op == "*" else size / factor), inner
    if node.op == "*" and not node.args[0].names:
        size, inner = without_factor(node.args[1])
        return size * float(Expression("", node.args[0])()), inner
    return 1.0, node


def _weights(model: Machine, node: Node) -> tuple[tuple[tuple[str, float], ...], float] | None:
    """Weights by signal and constant of a sum; None where it is none, or of other signals."""
    linear = Expression("", node)
    kinds = {s.name: s.kind for s in model.signals}
    weights = []
    for name in linear.names:
        slope = linear.derivative(name)
        signal = model.position if name == "x" and name not in kinds else name
        if slope.names or kinds.get(signal) not in (PRESSURE, POSITION):
            return None
        weights.append((signal, float(slope())))
    if not weights:
        return None
    return tuple(weights), float(linear(**dict.fromkeys(linear.names, 0.0)))


def _of_one_pressure(model: Machine, node: Node) -> list[_Form]:
    """A function of one pressure as that pressure, or as a sum of -1 / (P + c); else none.

    No sum either where a declared range lets the pressure reach zero.
    """
    names, kinds = node.names, {s.name: s for s in model.signals}
    if len(names) != 1 or kinds[names[0]].kind != PRESSURE:
        return []
    weights = ((names[0], 1.0),)
    p = np.geomspace(LEAST_PA * (1 + 1e-9), MOST_PA, 200)
    slope = np.asarray(Expression("", derivative(node, names[0]))(**{names[0]: p}))
    mean = float(slope.mean())
    if np.abs(slope - mean).max() < STRAIGHT * abs(mean):
        return [_Form(mean, weights, 0.0, "linear")]
    if kinds[names[0]].minimum <= 0.0:
        return []
    pairs = zip(SHIFTS_PA, shares(p, slope), strict=True)
    return [_Form(gain, weights, shift, "inverse") for shift, gain in pairs if gain > 0]


def shares(p: FloatArray, slope: FloatArray) -> FloatArray:
    """g (k,), not negative, so that the sum of g / (P + SHIFTS_PA)^2 is slope (n,) at p (n,) Pa.

    Zero where no such sum comes close.
    """
    if not (slope > 0).all():
        return np.zeros(len(SHIFTS_PA))
    columns = 1.0 / (p[:, None] + np.array(SHIFTS_PA)) ** 2 / slope[:, None]
    scale = columns.max(axis=0)
    from scipy.optimize import nnls  # noqa: PLC0415 - takes long to import

    gains = nnls(columns / scale, np.ones(len(p)))[0] / scale
    return np.asarray(gains if np.abs(columns @ gains - 1.0).max() < DESCRIBED else 0.0 * gains)
