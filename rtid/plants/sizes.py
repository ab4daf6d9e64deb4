"""How large an effect can be in this record: bounds and start values of the parameters it adds.

A term is measured against the largest term of its state's rate along the present free run, a limit
against the range of its signal, a time against the record.  The catalogue's own ranges are for
hydraulic machines in SI; only its signs hold for every plant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rtid.effects.tree import Node, derivative, evaluate, named, number, substituted
from rtid.plain import FloatArray
from rtid.plants.entries import AMPLITUDE, GAP, INPUT, LIMIT, RATE, SHARE, SPEED, STATE, TIME
from rtid.plants.insertion import EffectParameter, Insertion
from rtid.plants.output_error import PlantFit
from rtid.plants.plant import Plant

LANES = 48  # start values of a candidate
LARGEST = 10.0  # amplitude of a term, in units of the largest term of its rate
FASTEST = 4.0  # rate of an effect, per sample
CREEP = 0.005  # of a velocity's rms: below it a friction that reverses its sign is taken as linear
JITTER = 0.3  # by which the present values are moved in every second start


@dataclass(frozen=True)
class Range:
    """Bounds of a new parameter, and where its start values are drawn from."""

    low: float
    high: float
    draw: tuple[float, float]
    logarithmic: bool


def sized(insertion: Insertion, present: PlantFit) -> Insertion:
    """The insertion with bounds, and with friction that passes smoothly through rest."""
    plant = _smooth(insertion, present)
    by = {a.name: _range(replace(insertion, plant=plant), a, present) for a in insertion.added}
    parameters = tuple(
        replace(p, start=_middle(by[p.name]), low=by[p.name].low, high=by[p.name].high)
        if p.name in by
        else p
        for p in plant.parameters
    )
    return replace(insertion, plant=replace(plant, parameters=parameters))


def starts(insertion: Insertion, present: PlantFit, n: int = LANES) -> FloatArray:
    """Start values (n, unknowns), in their units: the present, every second moved, new ones."""
    rng = np.random.default_rng(1)
    known = {p.name: v for p, v in zip(present.plant.unknowns, present.values, strict=True)}
    added = {a.name: a for a in insertion.added}
    columns = []
    for p in insertion.plant.unknowns:
        if p.name in added:
            columns.append(_drawn(_range(insertion, added[p.name], present), added[p.name], rng, n))
        else:
            factor = np.exp(JITTER * rng.standard_normal(n) * (np.arange(n) % 2))
            columns.append(np.clip(known[p.name] * factor, p.low, p.high))
    return np.column_stack(columns)


def _drawn(bounds: Range, added: EffectParameter, rng: np.random.Generator, n: int) -> FloatArray:
    low, high = bounds.draw
    if not bounds.logarithmic:
        return rng.uniform(low, high, n)
    sizes = np.exp(rng.uniform(np.log(low), np.log(high), n))
    return sizes * rng.choice([-1.0, 1.0], n) if added.sign == 0 else sizes


def _middle(bounds: Range) -> float:
    low, high = bounds.draw
    return float(np.sqrt(low * high)) if bounds.logarithmic else 0.5 * (low + high)


def _range(insertion: Insertion, added: EffectParameter, present: PlantFit) -> Range:
    if added.kind == AMPLITUDE:
        return _amplitude(insertion, added, present)
    sizes: dict[str, Callable[[], Range]] = {
        INPUT: lambda: _input(insertion, present),
        LIMIT: lambda: _input(insertion, present),
        STATE: lambda: _level(insertion, present),
        SPEED: lambda: _speed(insertion, present),
        GAP: lambda: _gap(insertion, present),
        TIME: lambda: _time(present),
        RATE: lambda: _rate(present),
        SHARE: lambda: Range(0.0, 1.0, (0.05, 0.95), logarithmic=False),
    }
    return sizes[added.kind]()


def _along(plant: Plant, present: PlantFit) -> dict[str, FloatArray]:
    """States, inputs as recorded and parameters along the present free run, by name."""
    record = present.simulator.record
    series = {s.name: present.states[:, k] for k, s in enumerate(present.plant.states)}
    series |= {i.name: record.u[:, k] for k, i in enumerate(plant.inputs)}
    series |= {p.name: np.asarray(p.start) for p in plant.parameters}
    return series | {
        p.name: np.asarray(v) for p, v in zip(present.plant.unknowns, present.values, strict=True)
    }


def _amplitude(insertion: Insertion, added: EffectParameter, present: PlantFit) -> Range:
    """So large that the term is as large as the others of its rate."""
    plant, acts = insertion.plant, {i.name: i.acts for i in insertion.plant.inputs}
    along = _along(plant, present)
    along |= {a.name: np.asarray(_shape(a, insertion, present)) for a in insertion.added}
    rate = substituted(plant.state(insertion.where).rate, acts)
    unit = _rms(evaluate(derivative(rate, added.name), along))
    terms = [t for t in _terms(rate) if added.name not in t.names]
    size = max([_rms(evaluate(t, along)) for t in terms], default=0.0) / max(unit, 1e-300)
    high = LARGEST * size if 0 < size < 1e290 else LARGEST
    return Range(0.0 if added.sign else -high, high, (high * 1e-3, high * 0.1), logarithmic=True)


def _shape(added: EffectParameter, insertion: Insertion, present: PlantFit) -> float:
    return 0.0 if added.kind == AMPLITUDE else _middle(_range(insertion, added, present))


def _terms(node: Node) -> list[Node]:
    if node.op in ("+", "-"):
        return [term for arg in node.args for term in _terms(arg)]
    return [node]


def _rms(values: FloatArray) -> float:
    with np.errstate(all="ignore"):
        return float(np.sqrt(np.nanmean(np.square(values))))


def _state(insertion: Insertion, present: PlantFit) -> FloatArray:
    names = [s.name for s in present.plant.states]
    return np.asarray(present.states[:, names.index(insertion.where)])


def _level(insertion: Insertion, present: PlantFit) -> Range:
    x = _state(insertion, present)
    low, high = float(x.min()), float(x.max())
    width = max(high - low, 1e-12)
    return Range(low, high + width, (low + 0.3 * width, high), logarithmic=False)


def _speed(insertion: Insertion, present: PlantFit) -> Range:
    size = max(_rms(_state(insertion, present)), 1e-12)
    return Range(CREEP * size, size, (2 * CREEP * size, 0.5 * size), logarithmic=True)


def _input(insertion: Insertion, present: PlantFit) -> Range:
    names = [i.name for i in present.plant.inputs]
    u = np.abs(present.simulator.record.u[:, names.index(insertion.where)])
    high = max(float(u.max()), 1e-12)
    return Range(0.0, high, (0.01 * high, 0.95 * high), logarithmic=False)


def _gap(insertion: Insertion, present: PlantFit) -> Range:
    names = [o.name for o in present.plant.outputs]
    y = present.simulator.record.y[:, names.index(insertion.where)]
    width = max(float(np.nanmax(y) - np.nanmin(y)), 1e-12)
    return Range(0.0, 0.5 * width, (0.003 * width, 0.3 * width), logarithmic=True)


def _time(present: PlantFit) -> Range:
    t = present.simulator.record.t_s
    step, length = float(np.median(np.diff(t))), float(t[-1] - t[0])
    low = 0.5 * step / present.simulator.sub_steps
    return Range(low, max(0.1 * length, 10 * low), (2 * low, max(0.02 * length, 4 * low)), True)


def _rate(present: PlantFit) -> Range:
    t = present.simulator.record.t_s
    high = FASTEST / float(np.median(np.diff(t)))
    low = min(1.0 / float(t[-1] - t[0]), 0.1 * high)
    return Range(low, high, (0.01 * high, high), logarithmic=True)


def _smooth(insertion: Insertion, present: PlantFit) -> Plant:
    """sign(v) of a force becomes tanh(v / creep): a step that no solver can stand on is gone."""
    plant, where = insertion.plant, insertion.where
    if where not in {s.name for s in present.plant.states}:
        return plant
    state = plant.state(where)
    creep = CREEP * max(_rms(_state(insertion, present)), 1e-12)
    return plant.with_state(replace(state, rate=_rounded(state.rate, where, creep)))


def _rounded(node: Node, name: str, creep: float) -> Node:
    if node.op == "sign" and node.args == (named(name),):
        return Node("tanh", (Node("/", (named(name), number(creep))),))
    return replace(node, args=tuple(_rounded(arg, name, creep) for arg in node.args))
