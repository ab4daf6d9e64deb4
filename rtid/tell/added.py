"""The effects that a model has beside its maps, in words."""

from __future__ import annotations

from collections.abc import Iterator

from rtid.effects.page import title
from rtid.study.known_effects import KnownEffect
from rtid.tell.words import quantity


def sentences(added: tuple[KnownEffect, ...]) -> Iterator[str]:
    """What the model has beside its maps, and what the free run can say of it."""
    for known in added:
        sizes = ", ".join(
            f"{name.replace('_', ' ')} {quantity(v)}" for name, v in known.parameters.items()
        )
        yield f"The model has {title(known.effect)} at {known.where}: {sizes}."
    apart = [title(known.effect) for known in added if not known.follows]
    if apart:
        yield (
            f"The flow of {', '.join(apart)} is taken from the measured pressures, also where "
            "pressures are simulated: these are no free run of it."
        )
