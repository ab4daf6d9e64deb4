"""The catalogue of physical effects: one small page per effect, `rtid/effects/pages/NAME.toml`.

An effect is a term that may be missing in a chamber's pressure equation

    s_c A_c v = - V_c(x) dP_c/dt * theta_beta_c + sum of sigma * Q_edge(u, dp) + effects

or in the state equation of a generic plant.  A page says what it is, in symbols with units, how
large it can be, what it looks like in the residual, what it cannot be told from, and which motion
shows it.  Coefficients are defined so that a physically possible one has the sign that is given.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

from rtid.effects.tree import FUNCTIONS
from rtid.errors import RtidError

# What the effect does to the model; the key of a page, and how `rtid effects` heads its group.
KINDS = {
    "flow": "flows into or out of a chamber",
    "storage": "oil that is stored: -V dG/dt or -C dP/dt in a chamber",
    "timing": "a command or a sensor that comes late or distorted, before the map",
    "supply": "a pressure that is not what the model takes it for",
    "map": "a change of the flow map, or nothing that a free map can see",
    "mechanical": "forces and gears of a generic plant: x'' = ... (never in a pressure equation)",
    "generic": "terms of a generic plant: x' = phi(x)' theta + f(u, x)",
}
PLACES = ("chamber", "both chambers", "edge", "command", "sensor", "supply", "state")


class EffectError(RtidError):
    """An effect that does not exist or cannot be used."""

    exit_code = 2


@dataclass(frozen=True)
class Parameter:
    """A parameter: SI unit, plausible range [low, high], sign of a possible value (0: either)."""

    name: str
    unit: str
    symbol: str
    low: float
    high: float
    sign: int
    meaning: str


@dataclass(frozen=True)
class Symbol:
    """A quantity of an equation: its SI unit and what it is."""

    name: str
    unit: str
    meaning: str


@dataclass(frozen=True)
class Effect:
    """One page.

    equation: lines "left = right" in the language of `rtid.effects.expression`, with the notations
    ddt(z), delay(z, tau) and play(z, width) besides; symbols: all quantities in them that are not
    parameters.  places: where it may act.  signals: what must be measured.  confounders: names of
    effects that look alike.  separates: the motion that tells them apart.  visible_when: under
    which conditions it can be seen at all; `invisible` if a free map swallows it always.
    """

    name: str
    title: str
    kind: str
    places: tuple[str, ...]
    summary: str
    equation: tuple[str, ...]
    symbols: tuple[Symbol, ...]
    parameters: tuple[Parameter, ...]
    signals: tuple[str, ...]
    signature: str
    confounders: tuple[str, ...]
    separates: str
    visible_when: str
    invisible: bool
    reference: str


@cache
def catalogue() -> Mapping[str, Effect]:
    """All effects by name, in the order of their kinds, then of their names."""
    folder = files("rtid.effects")
    common = tomllib.loads((folder / "symbols.toml").read_text("utf-8"))
    pages = (p for p in (folder / "pages").iterdir() if p.name.endswith(".toml"))
    found = [_read(p.name[:-5], tomllib.loads(p.read_text("utf-8")), common) for p in pages]
    order = list(KINDS)
    found.sort(key=lambda e: (order.index(e.kind), e.name))
    return MappingProxyType({effect.name: effect for effect in found})


def effect(name: str) -> Effect:
    """The effect of that name; EffectError names the nearest."""
    if name not in catalogue():
        near = [known for known in catalogue() if name in known] if name else []
        near += get_close_matches(name, list(catalogue()), n=4, cutoff=0.5)
        hint = f"did you mean {' or '.join(dict.fromkeys(near))}?" if near else ""
        remedy = f"{hint} `rtid effects` lists them all".strip()
        raise EffectError(f"there is no effect {name!r}", remedy)
    return catalogue()[name]


def _read(name: str, page: dict[str, Any], common: dict[str, str]) -> Effect:
    """One page from its TOML; `common` gives symbols ("unit: meaning") that many pages use."""
    page = {key: _tidy(value) for key, value in page.items()}
    own = page.pop("symbols", {})
    parameters = tuple(Parameter(**entry) for entry in page.pop("parameters"))
    equation = tuple(page.pop("equation"))
    taken = {parameter.symbol for parameter in parameters}
    symbols = tuple(
        _symbol(word, own.get(word) or common.get(word, ""))
        for word in words_of(equation)
        if word not in taken
    )
    lists: dict[str, Any] = {
        key: tuple(page.pop(key)) for key in ("places", "signals", "confounders")
    }
    page = {"invisible": False} | page
    return Effect(
        name=name, equation=equation, symbols=symbols, parameters=parameters, **lists, **page
    )


def _tidy(value: Any) -> Any:
    """A paragraph in one line."""
    return " ".join(value.split()) if isinstance(value, str) else value


NOTATION = ("ddt", "delay", "play")  # of an equation, besides the functions of an expression


def words_of(equation: tuple[str, ...]) -> tuple[str, ...]:
    """The quantities in the lines, in the order of their appearance."""
    words = [word for line in equation for word in re.findall(r"[A-Za-z_]\w*", line)]
    return tuple(dict.fromkeys(w for w in words if w not in FUNCTIONS and w not in NOTATION))


def _symbol(name: str, text: str) -> Symbol:
    unit, _, meaning = text.partition(":")
    return Symbol(name, unit.strip(), meaning.strip())


def readable(line: str) -> str:
    """An equation as it is printed: d/dt, powers and products as on paper."""
    line = re.sub(r"\bddt\(", "d/dt(", line).replace(" * ", " · ")
    line = re.sub(r"\*\*(\w+)", r"^\1", line).replace("**", "^")
    return re.sub(r"d/dt\((\w+)\)", r"d\1/dt", line)
