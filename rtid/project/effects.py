"""The user's own effects: the formulas of [effects.NAME], and the Python file of `effects_module`.

The formulas are read, never run (`rtid.effects.expression`).  The Python file is ordinary code: it
is run only where the user has trusted exactly this content (`rtid.project.trust`), and every
`Effect` among its global names is taken.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from firmware_bridge.catalog import Catalog
from rtid.effects import Effect, EffectError, ExpressionError, catalogue, from_expression, names_of
from rtid.project import references, trust
from rtid.project.errors import Problem
from rtid.project.schema import EffectSection
from rtid.project.sections import Raw, read_section
from rtid.units import nearest


def read(raw: Any, path: str) -> tuple[EffectSection | None, list[Problem]]:
    """One [effects.NAME]: the keys that hold lists are its shape parameters."""
    if not isinstance(raw, dict):
        return read_section(EffectSection, raw, path)
    shapes = {key: value for key, value in raw.items() if isinstance(value, list)}
    plain = {key: value for key, value in raw.items() if key not in (*shapes, "shapes")}
    section, problems = read_section(EffectSection, plain | {"shapes": shapes}, path)
    shown = [replace(p, path=p.path.replace(f"{path}.shapes.", f"{path}.")) for p in problems]
    if "shapes" in raw:
        remedy = "write each shape parameter as a key of its own, x0 = [0.1, 0.2]"
        shown.append(Problem(f"{path}.shapes", "unknown key", remedy))
    return section, shown


def build(
    parts: dict[str, Any], raw: Raw, catalog: Catalog | None, folder: Path
) -> tuple[tuple[Effect, ...], list[Problem]]:
    """All effects of the file and of its module, and what is wrong with them."""
    signals = references.tables(raw, "signals").items()
    kinds = {n: references.kind_of(s, references.find_dbc_unit(s, catalog)) for n, s in signals}
    rate = references.table(raw, "rate")
    named = (*references.tables(raw, "chambers"), rate.get("state"), rate.get("measured"))
    chambers = [str(name) for name in named if name]
    names = names_of(kinds, chambers)
    geometry = parts.get("geometry")
    constants = {"stroke": geometry.stroke_m} if geometry and geometry.stroke_m else {}
    user_effects: dict[str, Effect] = {}
    problems: list[Problem] = []
    for name, section in parts.get("effects", {}).items():
        path = f"effects.{name}"
        effect = section and _from_section(name, section, names, constants, problems)
        if effect:
            problems += _fit(effect, path, f"{path}.chambers", chambers, user_effects)
            user_effects[name] = effect
    module = getattr(parts.get("project"), "effects_module", None)
    for effect in _from_module(folder, module, problems) if module else ():
        path = "project.effects_module"
        problems += _fit(effect, path, path, chambers, user_effects)
        user_effects[effect.name] = effect
    return tuple(user_effects.values()), problems


def _from_section(
    name: str,
    section: EffectSection,
    names: dict[str, Any],
    constants: dict[str, float],
    problems: list[Problem],
) -> Effect | None:
    """The effect of one section; what is wrong with it joins `problems` (changed in place)."""
    path = f"effects.{name}"
    keys = section.model_dump(exclude={"flow", "unit"}, exclude_none=True)
    try:
        return from_expression(
            name, section.flow, section.unit, names=names, constants=constants, **keys
        )
    except ExpressionError as error:
        place = "unit" if error.text == section.unit else "flow"
        problems.append(Problem(f"{path}.{place}", error.in_one_line, error.remedy))
    except EffectError as error:
        text = str(error).removeprefix(f"effect {name!r}: ")
        problems.append(Problem(path, text, error.remedy))
    return None


def _fit(
    effect: Effect, path: str, place: str, chambers: list[str], others: dict[str, Effect]
) -> Iterator[Problem]:
    """Chambers that do not exist, names that are taken."""
    for chamber, _ in effect.into:
        if chamber not in chambers:
            where = place if place == path else f"{place}.{chamber}"
            yield Problem(
                where, f"{effect.name}: no chamber {chamber!r}", nearest(chamber, chambers)
            )
    if effect.name in others:
        yield Problem(path, f"the effect {effect.name!r} is defined twice", "rename one")
    if effect.name in catalogue():
        yield Problem(path, f"{effect.name!r} is an effect of the catalogue", "choose another name")


def _from_module(folder: Path, name: str, problems: list[Problem]) -> list[Effect]:
    """Run a trusted file and take its effects; an error joins `problems` (changed in place)."""
    place = "project.effects_module"
    path, wrong = trust.located(folder, name)
    if wrong:
        problems.append(Problem(place, *wrong))
        return []
    content = path.read_bytes()
    if not trust.is_trusted(content):
        return []
    module = ModuleType(path.stem)
    try:  # these very bytes, and no compiled file that lies beside
        exec(compile(content, str(path), "exec"), vars(module))
    except (Exception, SystemExit) as error:
        problems.append(Problem(place, _where(path, error), "correct the Python file"))
        return []
    user_effects = list({id(v): v for v in vars(module).values() if isinstance(v, Effect)}.values())
    if not user_effects:
        problems.append(Problem(place, f"{path} defines no effect", "use rtid.effects.define"))
    return user_effects


def _where(path: Path, error: BaseException) -> str:
    """The error with the line of the user's own file that it comes from."""
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(path)]
    line = error.lineno if isinstance(error, SyntaxError) else (lines or [None])[-1]
    return f"{path}, line {line}: {type(error).__name__}: {error}"
