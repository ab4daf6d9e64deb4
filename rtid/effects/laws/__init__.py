"""Every effect whose column is known once the map is: by its equation, or by a law with a name.

A page names a law that its equation cannot say: one of NAMED, of the commands' (`timing`), or a
function (view, effect) -> causes of another package, "package.module:function".
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module

from rtid.effects.column import Candidate, Cause, by_equation
from rtid.effects.law import BEHIND_MAPS, GAIN_DRIFT, needs_no_pressure, placed_on
from rtid.effects.laws.drift import gain_drift
from rtid.effects.laws.friction import dahl
from rtid.effects.laws.lines import lines
from rtid.effects.laws.openings import POPPET_OUT, opening
from rtid.effects.laws.response import map_lag
from rtid.effects.laws.sensors import late_position, late_pressure
from rtid.effects.laws.storage import SEED, add_echoes, total_softness
from rtid.effects.laws.supply import supply
from rtid.effects.laws.timing import COMMAND_LAWS
from rtid.effects.magnitude import page_for
from rtid.effects.page import Effect, EffectError, catalogue
from rtid.effects.record_view import RecordView
from rtid.units import nearest

__all__ = ["NAMED", "SEED", "add_echoes", "cause_of", "causes", "total_softness"]

Law = Callable[[RecordView, Effect], Iterator[Cause]]
NAMED: dict[str, Law] = {
    POPPET_OUT: partial(opening, sign=1.0),
    "poppet_in": partial(opening, sign=-1.0),
    "line": lines,
    "pump": supply,
    "late_pressure": late_pressure,
    "late_position": late_position,
    BEHIND_MAPS: map_lag,
    "dahl": dahl,
    GAIN_DRIFT: gain_drift,
}


def causes(view: RecordView, suspects: tuple[Effect, ...] = ()) -> list[Cause]:
    """The causes that this machine and record have columns for; none without all pressures.

    suspects: effects of the user's beside those of the catalogue.
    """
    return [cause for effect in (*catalogue().values(), *suspects) for cause in _of(view, effect)]


def cause_of(view: RecordView, candidate: Candidate) -> Cause:
    """The cause that made a candidate."""
    return next(cause for cause in _of(view, candidate.law) if cause.makes(candidate))


def _of(view: RecordView, effect: Effect) -> Iterator[Cause]:
    if not view.has_pressures or effect.law in COMMAND_LAWS or effect.no_law:
        return
    if not (view.model.has_pressures or needs_no_pressure(effect)):
        return
    effect = page_for(effect, view.model)
    if effect.law:
        yield from law_of(effect)(view, effect)
        return
    for placed in placed_on(view, effect):
        yield by_equation(view, placed)


def law_of(effect: Effect) -> Law:
    """The law that a page names; EffectError where there is none of that name."""
    if effect.law in NAMED:
        return NAMED[effect.law]
    module, _, name = effect.law.partition(":")
    try:
        law: Law = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        remedy = f"{nearest(effect.law, [*NAMED, *COMMAND_LAWS])}, or package.module:function"
        raise EffectError(f"effect {effect.name!r}: no law {effect.law!r}", remedy) from error
    return law
