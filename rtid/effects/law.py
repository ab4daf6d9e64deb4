"""The law of an effect, read from its equation: what a unit of it adds to every chamber.

    q_a = -C * (p_a - p_b), q_b = ...    between the two chambers
    q_c = term                           into each chamber, or into both alike
    q_c = sigma * term                   by an edge, or by all of them
    q_c = outer * ddt(inner)             of what is stored; "G = ..." may stand before it
    q_c = outer * ddt(lag(inner, tau))   of what is stored behind a narrow port

The column that a diagnosis scores, the term that runs live and in free runs, and what a unit takes
up per Pa follow from these.  What an equation cannot say is a law by name in `rtid.effects.laws`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from types import MappingProxyType

import numpy as np

from rtid.effects.expression import Expression
from rtid.effects.filtering import filtered
from rtid.effects.motions import RATE, halves_of, motions, rates, velocity
from rtid.effects.page import FUNCTION, Effect, EffectError
from rtid.effects.parsing import ExpressionError
from rtid.effects.record_view import RecordView, supply_of, tank_of
from rtid.effects.tree import NAME, ZERO, Node, derivative, evaluate, number, substituted
from rtid.effects.view import View as Seen
from rtid.model import PRESSURE, Chamber, Edge, Machine
from rtid.plain import FloatArray

MODULUS, LENGTH, BEGIN = "beta", "t_r", "t_m"  # what only a fit knows: oil, length of the record
BOTH, ALL_EDGES, EACH_EDGE = "both", "all valves", "edge"
PORT = "port"  # the pressure behind a port of what drives a rate
MOVED, PRESSED = "v_y", "press"  # a velocity beside what is measured, a pressure that presses there
MOTION = "motion"  # the place of what such a velocity gives
MAP = "Q of "  # before an edge's name: its flow by the fitted map
LAGGED = "lag("  # before what is stored behind a port
BEHIND_MAPS = "behind_maps"
GAIN_DRIFT = "gain_drift"  # the law of one gain of all maps that drifts
OF_RATES = (BEHIND_MAPS, "dahl", GAIN_DRIFT)  # laws by name of plants without pressures
SELDOM = 0.005  # share of the samples, below which a chamber stores nothing of an effect
NO_SHAPE: Mapping[str, float] = MappingProxyType({})
Nodes = Mapping[str, Node]
Volumes = dict[int, FloatArray]  # chamber -> (n - 1,) m3
Shape = tuple[float, ...]


@dataclass(frozen=True)
class LawLine:
    """One line of an equation for a coefficient of 1: q_left = outer, or outer * d(inner)/dt.

    late: the symbol of the time constant that the inner follows itself with, "" for none.
    """

    left: str
    outer: Node
    inner: Node | None
    late: str = ""

    def put(self, by: Nodes) -> LawLine:
        """The line with names replaced by trees."""
        inner = substituted(self.inner, by) if self.inner is not None else None
        return replace(self, outer=substituted(self.outer, by), inner=inner)

    @property
    def names(self) -> set[str]:
        """All names in it."""
        return {n for node in (self.outer, self.inner) if node is not None for n in node.names}


@dataclass(frozen=True)
class Placed:
    """An effect at one place of a machine: its lines by chamber, in the names of the machine.

    Names that no record has are the symbols of nonlinear parameters.
    """

    effect: Effect
    where: str
    lines: tuple[tuple[int, LawLine], ...]

    def volumes(self, view: RecordView, shape: Shape) -> Volumes:
        """Volume per interval (n - 1,) and chamber that a coefficient of 1 adds, m3."""
        values, result = self._values(view, shape), dict[int, FloatArray]()
        acts = self._acts(self._soft(view, shape)) if self.where == BOTH else 1.0
        for c, line in self.lines:
            volume = acts * values.volume(line)
            _refuse_endless(self.effect, view.t_s, volume, values.values)
            result[c] = result[c] + volume if c in result else volume
        return result

    def softness(self, view: RecordView, shape: Shape) -> Volumes:
        """What a coefficient of 1 takes up per Pa of the chamber's pressure (n,), m3/Pa."""
        soft = self._soft(view, shape)
        acts = self._acts(soft)
        return {c: acts * each for c, each in soft.items()}

    def _soft(self, view: RecordView, shape: Shape) -> Volumes:
        """Of each chamber by itself what a coefficient of 1 takes up per Pa (n,), m3/Pa."""
        values, result = self._values(view, shape), dict[int, FloatArray]()
        for c, line in self.lines:
            if line.inner is not None:
                slope = derivative(line.inner, view.model.chambers[c].pressure)
                result[c] = -values.at_samples(line.outer) * values.at_samples(slope)
        return result

    def _acts(self, soft: Volumes) -> float:
        """0 for what is stored in both chambers and acts in one alone: it is that one's; 1 else."""
        if self.where != BOTH:
            return 1.0
        shares = [float(np.mean(each != 0.0)) for each in soft.values()]
        return float(min(shares, default=1.0) > SELDOM)

    def lag_s(self, shape: Shape) -> float:
        """The time constant that what is stored follows itself with; 0 where there is none."""
        values = {p.symbol: value for p, value in zip(self.effect.shapes, shape, strict=True)}
        return max((values.get(line.late, 0.0) for _, line in self.lines), default=0.0)

    def _values(self, view: RecordView, shape: Shape) -> Values:
        pairs = zip(self.effect.shapes, shape, strict=True)
        return Values(self.effect, view, {p.symbol: value for p, value in pairs})


@cache
def lines_of(effect: Effect) -> tuple[LawLine, ...]:
    """The lines of an effect's equation that say what flows into chambers, for a coefficient of 1.

    Empty where the equation says something else.  One line a side: a second one of the same left
    side describes more than a flow of the present (a poppet with a state).  Beside a law by name
    the equation may be words for a reader; else EffectError for one that cannot be read.
    """
    try:
        return tuple(_lines(effect).values())
    except ExpressionError as error:
        if effect.law:
            return ()
        raise EffectError(f"the equation of {effect.name}: {error}", _WRITE) from error


def _lines(effect: Effect) -> dict[str, LawLine]:
    known: dict[str, Node] = {
        p.symbol: number(p.start[0]) for p in effect.parameters[1:] if p.is_held
    }
    known |= {s.name: number(s.value) for s in effect.symbols if s.value is not None}
    result: dict[str, LawLine] = {}
    for text in effect.equation:
        left, _, right = (part.strip() for part in text.partition(" = "))
        is_flow = left.startswith("q_") and (left != "q_e" or bool(effect.into))
        if is_flow and left not in result:
            line = _line(left, right, effect.size.symbol, known)
            if line is not None:
                result[left] = line
        elif not is_flow and left.isidentifier() and "ddt(" not in right and _is_plain(right):
            known[left] = substituted(Expression.parse(right).root, known)
    return result


_WRITE = (
    "write it in p_a, p_b, p_c, p_tank, p_supply, x, v, t, u, V_c, dp, sigma and Q, or name a law: "
    "law = ..."
)


def _is_plain(text: str) -> bool:
    return not any(word in text for word in ("play(", "delay(", "Q("))


def _line(rest: str, right: str, coefficient: str, known: Nodes) -> LawLine | None:
    """One line; None where it has notations that are no law, or is not linear in the size."""
    if not _is_plain(right):
        return None
    outer, has_rate, inner = right.partition("ddt(")
    if has_rate:
        outer = outer.strip().removesuffix("*")
        if not inner.endswith(")") or "ddt(" in inner:
            return None
        inner = inner[:-1]
    late = ""
    if inner.startswith(LAGGED):
        inner, _, late = inner.removeprefix(LAGGED).removesuffix(")").rpartition(",")
    line = LawLine(rest, _tree(outer), _tree(inner) if has_rate else None, late.strip()).put(known)
    if line.inner is not None and coefficient in line.inner.names:
        line = replace(line, inner=derivative(line.inner, coefficient))
    else:
        line = replace(line, outer=derivative(line.outer, coefficient))
    return None if line.outer == ZERO or coefficient in line.names else line


def _tree(text: str) -> Node:
    return Expression.parse(text.strip()).root


def places_of(effect: Effect, model: Machine, compliance: FloatArray) -> Iterator[Placed]:
    """An effect wherever its equation can act on a machine; compliance (chambers,): 1/Pa.

    Empty where its equation is no law.  EffectError for a name that no record has.
    """
    lines = lines_of(effect)
    for where, meant in _places(effect, model, lines):
        at = tuple(meant)
        oil = float(np.mean(compliance[[c for c, _, _ in at]])) if len(compliance) else 0.0
        oils = {MODULUS: number(1.0 / oil if oil else np.inf)}
        fixed = oils | {LENGTH: number(1.0), BEGIN: number(0.0)} if not effect.into else {}
        placed = tuple((c, line.put(by).put(fixed)) for c, line, by in at)
        _refuse_unknown(effect, model, placed)
        yield Placed(effect, where, placed)


def placed_on(view: RecordView, effect: Effect) -> tuple[Placed, ...]:
    """An effect wherever its equation can act on the machine of a record, found once a record."""
    if effect not in view.placed:
        view.placed[effect] = tuple(places_of(effect, view.model, view.compliance))
    return view.placed[effect]


Meant = Iterator[tuple[int, LawLine, dict[str, Node]]]  # chamber, line, meaning of its symbols


def _places(
    effect: Effect, model: Machine, lines: tuple[LawLine, ...]
) -> Iterator[tuple[str, Meant]]:
    """Places by name; at each the lines by chamber, with what their symbols mean there."""
    chambers, by_left = model.chambers, {line.left: line for line in lines}
    if not lines:
        return
    if effect.into:
        names = [c.name for c in chambers]
        if all(name in names for name, _ in effect.into):
            yield place_of(effect.into, names), _users(effect, model, lines)
    elif by_left.keys() == {"q_a", "q_b"}:
        if len(chambers) == 2:
            yield f"{chambers[0].name}-{chambers[1].name}", _across(model, lines)
    elif "sigma" in lines[0].names:
        line = lines[0]
        if EACH_EDGE in effect.places:
            for edge in model.edges:
                yield edge.name, _through(model, line, (edge,))
        elif not model.measured:  # whose maps are no valves
            yield ALL_EDGES, _through(model, line, model.edges)
    elif lines[0].names & {MOVED, PORT}:
        yield from _of_rate(model, lines[0])
    else:
        for where, at in chambers_by_place(model).items():
            if ("both chambers" if where == BOTH else "chamber") in effect.places:
                yield where, _alone(model, lines[0], at)


def chambers_by_place(model: Machine) -> dict[str, tuple[int, ...]]:
    """The chambers by name, and both where there are two."""
    result = {chamber.name: (c,) for c, chamber in enumerate(model.chambers)}
    return result | ({BOTH: (0, 1)} if len(result) == 2 else {})


def place_of(into: tuple[tuple[str, int], ...], chambers: list[str]) -> str:
    """The place of a flow by the chambers that it enters and leaves: "a", "a-b" or "both"."""
    names, signs = [name for name, _ in into], {sign for _, sign in into}
    return BOTH if len(names) == len(chambers) == 2 and len(signs) == 1 else "-".join(names)


def _users(effect: Effect, model: Machine, lines: tuple[LawLine, ...]) -> Meant:
    names = [c.name for c in model.chambers]
    for (name, _), line in zip(effect.into, lines, strict=True):
        yield names.index(name), line, {}


def _across(model: Machine, lines: tuple[LawLine, ...]) -> Meant:
    item, two = model.chambers
    both = _of_chamber(item, "a") | _of_chamber(two, "b") | _of_machine(model)
    for line in lines:
        yield int(line.left == "q_b"), line, both


def _alone(model: Machine, line: LawLine, at: tuple[int, ...]) -> Meant:
    for c in at:
        yield c, line, _of_chamber(model.chambers[c], "c") | _of_machine(model)


def _behind_port(model: Machine, line: LawLine, c: int, port: str, way: int) -> Meant:
    """Into the rate, while its command puts this port under pressure.

    What flows moves the state by the pressures' means ahead, what is stored by their change.
    """
    seen = [port, *(name for name, _ in model.chambers[c].ports if name != port)]
    if line.inner is None:
        seen = [model.ahead(name) for name in seen]
    by = {PORT: _signal(seen[0]), "other": _signal(seen[1] if len(seen) > 1 else "")}
    yield c, line, by | {"way": number(float(way))} | _of_machine(model)


def _of_rate(model: Machine, line: LawLine) -> Iterator[tuple[str, Meant]]:
    """Behind each port of a rate, or beside one that is measured, over each motion.

    Over each pressure as well where the line has one.
    """
    if PORT in line.names:
        for c, chamber in enumerate(model.chambers):
            for port, way in chamber.ports:
                yield port, _behind_port(model, line, c, port, way)
        return
    halves = halves_of(model)
    pressures = [s.name for s in model.signals if s.kind == PRESSURE and s.name not in halves]
    for moved in motions(model):
        for pressure in pressures if PRESSED in line.names else [""]:
            by = {MOVED: _signal(RATE + moved), PRESSED: _signal(pressure)} | _of_machine(model)
            yield f"{moved}-{pressure}".removesuffix("-"), iter([(0, line, by)])


def _through(model: Machine, line: LawLine, edges: tuple[Edge, ...]) -> Meant:
    """Into every chamber that an edge feeds or drains."""
    for c, chamber in enumerate(model.chambers):
        for edge in edges:
            if sign := edge.sign(chamber):
                drop = Node("-", (_signal(edge.source), _signal(edge.sink)))
                of_edge = {
                    "sigma": number(float(sign)), "dp": drop, "u": _signal(edge.command),
                    "Q": Node(NAME, name=MAP + edge.name),
                    "w": Node("*", (number(float(edge.direction)), _signal(edge.command))),
                }  # fmt: skip
                yield c, line, _of_chamber(chamber, "c") | _of_machine(model) | of_edge


def _of_chamber(chamber: Chamber, letter: str) -> dict[str, Node]:
    return {
        f"p_{letter}": _signal(chamber.pressure),
        f"V_{letter}": _signal(f"V_{chamber.name}"),
        f"A_{letter}": _signal(f"A_{chamber.name}"),
    }


def _of_machine(model: Machine) -> dict[str, Node]:
    command = next((edge.command for edge in model.edges), "")
    return {
        "p_tank": _signal(tank_of(model)), "p_supply": _signal(supply_of(model)),
        "u": _signal(command), "x": _signal(model.position),
    }  # fmt: skip


def _signal(name: str) -> Node:
    """A name of the machine; "" is a pressure of zero."""
    return Node(NAME, name=name) if name else ZERO


def _refuse_unknown(
    effect: Effect, model: Machine, placed: tuple[tuple[int, LawLine], ...]
) -> None:
    known = {s.name for s in model.signals} | {"t", "x", "v"} | {p.symbol for p in effect.shapes}
    known |= {f"{letter}_{c.name}" for c in model.chambers for letter in "VA"}
    known |= rates(model)
    known |= {MAP + edge.name for edge in model.edges} | ({FUNCTION} if effect.function else set())
    unknown = sorted({name for _, line in placed for name in line.names} - known)
    if unknown:
        raise EffectError(
            f"the equation of {effect.name} uses {', '.join(unknown)}, which no record has",
            _WRITE,
        )


def _evaluated(node: Node, value: Callable[[str], FloatArray]) -> FloatArray:
    with np.errstate(all="ignore"):
        arrays = {name: value(name) for name in node.names}
        return np.asarray(evaluate(node, arrays), dtype=np.float64)


@dataclass(frozen=True)
class Values:
    """What the names in a line are worth on a record, with nonlinear parameters of these values."""

    effect: Effect
    view: RecordView
    values: Mapping[str, float]

    def at_samples(self, node: Node) -> FloatArray:
        """A tree at every sample (n,), SI."""
        return np.broadcast_to(_evaluated(node, self._here), self.view.t_s.shape)

    def _here(self, name: str) -> FloatArray:
        if name in self.values:
            return np.asarray(self.values[name])
        if self.effect.function is not None and name == FUNCTION:
            return flow_in_python(self.effect, self.view.seen, self.values)
        return self.view.seen.value(name)

    def volume(self, line: LawLine) -> FloatArray:
        """Over each interval (n - 1,), m3: the command is held, all else linear between samples."""
        if line.inner is None:
            return self._mean(line.outer) * self.view.dt_s
        lag_s = self.values.get(line.late, 0.0)
        inside = lagged(self.at_samples(line.inner), self.view.step_s, lag_s)
        return self._mean(line.outer) * np.diff(inside)

    def _mean(self, node: Node) -> FloatArray:
        """A tree over each interval (n - 1,), SI: half of what it is at both of its ends."""
        if FUNCTION not in node.names and not any(
            _is_of_intervals(n, self.view) for n in node.names
        ):
            here = self.at_samples(node)
            return np.asarray(0.5 * (here[1:] + here[:-1]))
        start, end = (_evaluated(node, at) for at in (self._at_start, self._at_end))
        return np.broadcast_to(0.5 * (start + end), self.view.dt_s.shape)

    def _at_start(self, name: str) -> FloatArray:
        if name.startswith((MAP, RATE)):
            return self._over_interval(name)
        here = self._here(name)
        return here[:-1] if here.ndim else here

    def _at_end(self, name: str) -> FloatArray:
        view = self.view
        if name.startswith((MAP, RATE)):
            return self._over_interval(name)
        if self.effect.function is not None and name == FUNCTION:
            return flow_in_python(self.effect, view.seen.before_the_next_command, self.values)
        here = self._here(name)
        return here if not here.ndim else here[:-1] if name in view.held else here[1:]

    def _over_interval(self, name: str) -> FloatArray:
        """A flow of the map, or the velocity of a motion (n - 1,), SI."""
        if name.startswith(RATE):
            return velocity(self.view, name)
        edges = [edge.name for edge in self.view.model.edges]
        return self.view.flow(edges.index(name.removeprefix(MAP)))


def _is_of_intervals(name: str, view: RecordView) -> bool:
    """True for what is one value an interval, and not linear between the samples."""
    return name in view.held or name.startswith((MAP, RATE))


def lagged(values: FloatArray, step_s: float, lag_s: float) -> FloatArray:
    """First-order lag of values (n,), SI, started at the first value; none for 0."""
    if lag_s <= 0.0:
        return values
    fade = float(np.exp(-step_s / lag_s))
    return filtered((1 - fade, 0.0, 0.0), (1.0, -fade, 0.0), values - values[0]) + values[0]


def flow_in_python(effect: Effect, seen: Seen, shape: Mapping[str, float]) -> FloatArray:
    """What the function of an effect gives (n,), m3/s per unit; EffectError where it fails."""
    assert effect.function is not None
    kept = {p.name: p.start[0] for p in effect.parameters[1:] if p.is_held}
    try:
        flow = np.asarray(effect.function(seen, **(kept | dict(shape))), dtype=np.float64)
        return np.broadcast_to(flow, seen.t_s.shape)
    except EffectError:
        raise
    except Exception as error:
        reason = f"effect {effect.name!r} fails: {type(error).__name__}: {error}"
        raise EffectError(reason, f"correct {effect.reference or 'its function'}") from error


def flow(effect: Effect, seen: Seen, shape: Mapping[str, float] = NO_SHAPE) -> FloatArray:
    """Flow of a user's effect for a coefficient of 1 (n,), m3/s, before the chambers' signs.

    Raises EffectError unless it is finite.
    """
    if effect.function is not None:
        values = flow_in_python(effect, seen, shape)
    else:
        (name, sign), *_ = effect.into
        line = next(line for line in lines_of(effect) if line.left == f"q_{name}")
        values = _evaluated(
            line.outer, lambda n: np.asarray(shape[n]) if n in shape else seen.value(n)
        )
        values = sign * np.broadcast_to(values, seen.t_s.shape)
    _refuse_endless(effect, seen.t_s, values, shape)
    return values


def _refuse_endless(
    effect: Effect, t_s: FloatArray, values: FloatArray, shape: Mapping[str, float]
) -> None:
    wrong = np.flatnonzero(~np.isfinite(values))
    if len(wrong):
        reason = f"effect {effect.name!r} is not finite in {len(wrong)} of {len(values)} samples"
        at = f"the first at {t_s[wrong[0]]:g} s" + (f", with {dict(shape)}" * bool(shape))
        raise EffectError(f"{reason}, {at}", "guard roots, logarithms and quotients")


def needs_no_pressure(effect: Effect) -> bool:
    """True where an effect can sit on a plant that has neither pressures nor volumes."""
    if effect.law:
        return effect.law in OF_RATES
    names = {name for line in lines_of(effect) for name in line.names}
    return bool(effect.into) or not any(n.startswith(("p_", "V_", "A_")) for n in names - {"A"})


def is_of_rates(effect: Effect) -> bool:
    """True for an effect between a command and a rate: no machine with pressures has it."""
    return effect.law in OF_RATES or bool({PORT, MOTION} & set(effect.places))


def fitted_names(effect: Effect) -> frozenset[str]:
    """Which of MODULUS and LENGTH multiply the coefficient: a fit knows them better than a column.

    Empty for a law by name.
    """
    lines = () if effect.law or effect.into else lines_of(effect)
    return frozenset(n for line in lines for n in line.names) & {MODULUS, LENGTH}
