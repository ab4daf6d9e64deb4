"""One chamber and its metering edges out of a machine: what one controller learns by itself."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

from rtid.estimator.limits import refuse_unfit
from rtid.mcu.errors import ValveError
from rtid.model import NONE, TAYLOR, Chamber, Edge, Machine, Term

Part = TypeVar("Part", Chamber, Edge)


def one_valve(model: Machine, chamber: str, edges: Sequence[str] = ()) -> Machine:
    """The part of a machine that is one chamber: its edges (all when none are named), its signals.

    Raises ValveError that names everything which the estimator in C does not do.
    """
    chamber_of = _named(model.chambers, [chamber], "chamber")[0]
    touching = tuple(edge for edge in model.edges if edge.sign(chamber_of) != 0)
    kept = _named(touching, edges, f"edge of chamber {chamber}") if edges else touching
    terms = tuple(
        _own_term(term, chamber_of) for term in model.terms if chamber_of.name in dict(term.signs)
    )
    faults = [*_faults(model), *_edge_faults(kept), *_term_faults(terms, chamber_of)]
    if faults:
        raise ValveError(
            "the estimator in C cannot learn this machine: " + "; ".join(faults),
            "declare a project of its own for the controller, without these",
        )
    used = _used_signals(model, chamber_of, kept, terms)
    signals = tuple(signal for signal in model.signals if signal.name in used)
    valve = replace(
        model, signals=signals, chambers=(chamber_of,), edges=kept, terms=terms, mode=NONE
    )
    try:
        refuse_unfit(valve)
    except ValueError as error:
        raise ValveError(str(error), "mend the project file") from error
    return valve


def _named(things: Sequence[Part], names: Sequence[str], what: str) -> tuple[Part, ...]:
    known = {thing.name: thing for thing in things}
    for name in names:
        if name not in known:
            raise ValveError(f"there is no {what} {name!r}", f"name one of {', '.join(known)}")
    return tuple(known[name] for name in names)


def _own_term(term: Term, chamber: Chamber) -> Term:
    return replace(term, signs=tuple(s for s in term.signs if s[0] == chamber.name))


def _faults(model: Machine) -> Iterator[str]:
    upkeep = model.upkeep
    if model.measured:
        yield f"rate.measured is {model.measured!r}, it knows a state, not its rate"
    if any(chamber.is_constant for chamber in model.chambers):
        yield "a motor that goes round for ever: it knows volumes that change with the position"
    if model.form != "integral":
        yield f"estimator.form is {model.form!r}, it knows 'integral'"
    if math.isfinite(upkeep.forget_s) or math.isfinite(upkeep.shared_forget_s):
        yield "upkeep.forget_s and shared_forget_s: it does not forget"
    if upkeep.innovation_sd > 0:
        yield "upkeep.innovation_sd: it holds no map to judge rows by"
    if upkeep.folds > 1:
        yield "upkeep.folds: it keeps one sum"


def _edge_faults(edges: tuple[Edge, ...]) -> Iterator[str]:
    if not edges:
        yield "the chamber has no metering edge"
    for edge in edges:
        if edge.basis != TAYLOR:
            yield f"edges.{edge.name}.basis is {edge.basis!r}, it knows 'taylor'"
        if edge.shares:
            yield f"edges.{edge.name}: it knows one command per map"
        if edge.modes:
            yield f"edges.{edge.name}: it knows no working modes"


def _term_faults(terms: tuple[Term, ...], chamber: Chamber) -> Iterator[str]:
    for term in terms:
        if term.rate and term.volume not in (NONE, chamber.name):
            yield f"term {term.name}: the volume of chamber {term.volume} is not its own"


def _used_signals(
    model: Machine, chamber: Chamber, edges: tuple[Edge, ...], terms: tuple[Term, ...]
) -> set[str]:
    used = {model.position, chamber.pressure}
    for edge in edges:
        used |= {edge.command, edge.source, edge.sink}
    return used.union(*({name for name, _ in term.weights} for term in terms))
