"""How an effect of the catalogue changes the equations of a plant, read from its page.

The form of the page's equation decides:

    ddt(h) = h_in + term      a term of the rate of state h
    q_c = term                the same, for a flow out of what the state measures
    F = term                  a force on the state v, divided by its inertia
    w = map(u)                the input acts through a map
    tau * ddt(w) = u - w      the input acts through a state of its own
    w = delay(u, T)           the input acts late
    y = play(z, width)        an output follows behind a gap

What an effect needs to know about the plant is in the plant: the quantity of a state, its inertia,
what surrounds it.  What overflows reaches those states of the same quantity that the overflowing
one feeds, each with a share of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from rtid.effects import Effect, Expression
from rtid.effects.tree import NAME, NEG, Node, named, number, substituted
from rtid.plants.entries import (
    GAP,
    INPUT,
    LIMIT,
    RATE,
    SHARE,
    SPEED,
    STATE,
    TIME,
    effects_of_plants,
    page_of,
)
from rtid.plants.plant import ANY, Input, Output, Plant, PlantError, PlantParameter, PlantState

SURROUNDINGS = ("T_amb", "p_tank", "h_a")


@dataclass(frozen=True)
class EffectParameter:
    """A parameter that an effect has brought in: its kind, and its name on the page."""

    name: str
    kind: str
    label: str
    sign: int


@dataclass(frozen=True)
class Insertion:
    """An effect at a place: the plant with it, and what it brought in (bounds still open)."""

    effect: str
    where: str
    plant: Plant
    added: tuple[EffectParameter, ...]

    @property
    def key(self) -> tuple[str, str]:
        """Effect and place."""
        return self.effect, self.where


def places(plant: Plant, name: str) -> tuple[str, ...]:
    """Where in the plant an effect may act: names of states, inputs or outputs."""
    page = page_of(name)
    form = _form(page)
    if form in ("map", "lag", "delay"):
        return tuple(i.name for i in plant.inputs)
    fitting = (*page.quantities, ANY)
    if form == "play":
        kinds = {s.name: s.quantity for s in plant.states}
        return tuple(
            o.name for o in plant.outputs if {kinds.get(n) for n in o.value.names} & {*fitting}
        )
    states = tuple(s for s in plant.states if s.quantity in fitting and not s.follows)
    if form == "force" and "z" in _right(page).names:
        states = tuple(s for s in states if _position(plant, s))
    elif form == "force":  # a force has no say in x' = v
        states = tuple(s for s in states if s.rate.op != NAME)
    return tuple(s.name for s in states)


def everywhere(plant: Plant) -> tuple[tuple[str, str], ...]:
    """Every effect at every place where it may act and does not act yet."""
    have = {p.name for p in plant.parameters}
    return tuple(
        (name, where)
        for name, page in effects_of_plants().items()
        for where in places(plant, name)
        if not any(_own(name, where, p.name) in have for p in page.parameters)
    )


def insert(plant: Plant, name: str, where: str) -> Insertion:
    """The plant with an effect added.  PlantError names the places where it may act."""
    page = page_of(name)
    possible = places(plant, name)
    if where not in possible:
        remedy = f"it may act at: {', '.join(possible)}" if possible else "no state is of its kind"
        raise PlantError(f"{name} cannot act at {where!r}", remedy)
    added = [
        EffectParameter(_own(name, where, p.name), p.size, p.name, p.sign) for p in page.parameters
    ]
    if added[0].name in {p.name for p in plant.parameters}:
        raise PlantError(f"{name} acts at {where!r} already", "drop it from the list")
    by = {p.symbol: named(a.name) for p, a in zip(page.parameters, added, strict=True)}
    build: Callable[..., Plant] = _BUILD[_form(page)]
    changed = build(plant, page, where, by)
    if page.spills:
        changed, shares = _spilled(plant, changed, where, name)
        added += shares
    new = tuple(PlantParameter(a.name, 1.0, 0.0, 1.0) for a in added)
    return Insertion(name, where, replace(changed, parameters=plant.parameters + new), tuple(added))


def _own(name: str, where: str, parameter: str) -> str:
    return f"{name}_{where}_{parameter}"


def _form(page: Effect) -> str:
    left, _, right = (side.strip() for side in page.equation[0].partition("="))
    if left.startswith("ddt("):
        return "rate"
    if left in ("F", "q_c"):
        return {"F": "force", "q_c": "flow"}[left]
    if "ddt(" in left:
        return "lag"
    word = right.partition("(")[0]
    return word if word in ("delay", "play") else "map"


def _right(page: Effect) -> Node:
    return Expression.parse(page.equation[0].partition("=")[2]).root


def _rate(plant: Plant, page: Effect, where: str, by: dict[str, Node]) -> Plant:
    """ddt(h) = h_in + term."""
    state = plant.state(where)
    symbol = page.equation[0].partition("(")[2].partition(")")[0]
    meaning = {symbol: named(where), f"{symbol}_in": state.rate} | _surroundings(state)
    return plant.with_state(replace(state, rate=substituted(_right(page), by | meaning)))


def _flow(plant: Plant, page: Effect, where: str, by: dict[str, Node]) -> Plant:
    """q_c = term."""
    state = plant.state(where)
    term = substituted(_right(page), by | {"p_c": named(where)} | _surroundings(state))
    return plant.with_state(replace(state, rate=_sum(state.rate, term)))


def _sum(rate: Node, term: Node) -> Node:
    """rate + term; "-a * b" becomes "rate - a * b"."""
    if term.op == "*" and term.args[0].op == NEG:
        return Node("-", (rate, replace(term, args=(term.args[0].args[0], term.args[1]))))
    return Node("+", (rate, term))


def _surroundings(state: PlantState) -> dict[str, Node]:
    return dict.fromkeys(SURROUNDINGS, state.ambient)


def _force(plant: Plant, page: Effect, where: str, by: dict[str, Node]) -> Plant:
    """F = term, m * ddt(v) = F_0 + F."""
    state = plant.state(where)
    meaning = {"v": named(where), "z": named(_position(plant, state) or where)}
    term = substituted(_right(page), by | meaning)
    if state.inertia != number(1.0):
        term = Node("/", (term, state.inertia))
    return plant.with_state(replace(state, rate=_sum(state.rate, term)))


def _position(plant: Plant, state: PlantState) -> str:
    """The state whose rate is this one."""
    return next((s.name for s in plant.states if s.rate == named(state.name)), "")


def _map(plant: Plant, page: Effect, where: str, by: dict[str, Node]) -> Plant:
    """w = map(u)."""
    given = _input(plant, where)
    acts = substituted(_right(page), by | {"u": given.acts})
    return plant.with_input(replace(given, acts=acts))


def _lag(plant: Plant, _page: Effect, where: str, by: dict[str, Node]) -> Plant:
    """tau_0 * ddt(w) = u - w."""
    given, new = _input(plant, where), f"{where}_lagged"
    rate = Node("/", (Node("-", (given.acts, named(new))), next(iter(by.values()))))
    state = PlantState(new, rate, unit=given.unit, follows=where)
    return plant.with_state(state).with_input(replace(given, acts=named(new)))


def _delay(plant: Plant, _page: Effect, where: str, by: dict[str, Node]) -> Plant:
    """w = delay(u, T_0)."""
    return plant.with_input(replace(_input(plant, where), delay=next(iter(by.values())).name))


def _play(plant: Plant, _page: Effect, where: str, by: dict[str, Node]) -> Plant:
    """y = play(z, w_b)."""
    output: Output = next(o for o in plant.outputs if o.name == where)
    return plant.with_output(replace(output, play=next(iter(by.values())).name))


_BUILD: dict[str, Callable[..., Plant]] = {
    "rate": _rate, "flow": _flow, "force": _force, "map": _map, "lag": _lag, "delay": _delay,
    "play": _play,
}  # fmt: skip


def _input(plant: Plant, where: str) -> Input:
    return next(i for i in plant.inputs if i.name == where)


def _spilled(
    before: Plant, plant: Plant, where: str, name: str
) -> tuple[Plant, list[EffectParameter]]:
    """A share of what the effect takes from one state enters those that this one feeds."""
    plant_state = plant.state(where)
    lost = plant_state.rate.args[-1]  # of "h_in - lost"
    added: list[EffectParameter] = []
    for state in before.states:
        alike = state.quantity == plant_state.quantity and not state.follows
        if state.name == where or not alike or where not in state.rate.names:
            continue
        share = EffectParameter(
            _own(name, where, f"into_{state.name}"), SHARE, f"into {state.name}", 1
        )
        gain = Node("*", (named(share.name), lost))
        fed = replace(state, rate=Node("+", (state.rate, gain)))
        plant, added = plant.with_state(fed), [*added, share]
    return plant, added


def unit_of(plant: Plant, effect_name: str, where: str, added: EffectParameter) -> str:
    """Unit of a parameter in the units of the plant, e.g. "V/s" for an offset of a level in V."""
    units = {s.name: s.unit for s in plant.states} | {i.name: i.unit for i in plant.inputs}
    units |= {o.name: o.unit for o in plant.outputs}
    unit = units.get(where, "")
    if added.kind in (INPUT, LIMIT, STATE, SPEED, GAP):
        return unit
    if added.kind in (TIME, RATE, SHARE):
        return {TIME: "s", RATE: "1/s", SHARE: "1"}[added.kind]
    page = page_of(effect_name)
    (parameter,) = (p for p in page.parameters if p.name == added.label)
    if _form(page) == "force" and plant.state(where).inertia != number(1.0):
        return parameter.unit
    position = units.get(_position(plant, plant.state(where)), "")
    return (parameter.plant_unit or "{u}/s").format(u=unit or "1", z=position or "1")
