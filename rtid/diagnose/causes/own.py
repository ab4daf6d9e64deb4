"""Effects that the user has defined."""

from __future__ import annotations

from collections.abc import Iterator

from rtid import effects
from rtid.diagnose.candidates import (
    Candidate,
    Cause,
    Volumes,
    fixed,
)
from rtid.diagnose.view import View


def own(view: View) -> Iterator[Cause]:
    """Effects that the user has defined: one cause per combination of their shape parameters."""
    names = [chamber.name for chamber in view.model.chambers]
    seen = effects.View(view.model, view.t_s, view.chunk[:, 2:])
    for effect in view.model.own_effects:
        signs = {names.index(name): sign for name, sign in effect.signs}
        for shape in effect.bank():
            parameter = ", ".join(["coefficient", *(f"{k} = {v:g}" for k, v in shape.items())])
            candidate = Candidate(
                effect.name, "own effect", parameter, effect.unit, effect.largest, effect.sign
            )
            yield fixed(candidate, _own_volumes, effect, seen, shape, signs)


def _own_volumes(
    effect: effects.UserEffect, seen: effects.View, shape: dict[str, float], signs: dict[int, int]
) -> Volumes:
    volume = effect.volume(seen, shape)
    return {c: sign * volume for c, sign in signs.items()}
