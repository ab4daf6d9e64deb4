"""The catalogue of physical effects: one small page per effect, `rtid/effects/pages/NAME.toml`.

An effect is a term that may be missing in a chamber's pressure equation

    s_c A_c v = - V_c(x) dP_c/dt * theta_beta_c + sum of sigma * Q_edge(u, dp) + effects

or in the state equation of a generic plant.  A page says what it is, in symbols with units, how
large it can be, what it looks like in the residual, what it cannot be told from, and which motion
shows it.  Coefficients are defined so that a physically possible one has the sign that is given.

The page is the effect: column, live term, bounds and words follow from it (`rtid.effects.law`).
Effects of a user's own and of plug-ins (entry points of the group `rtid.effects`) are the same.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from difflib import get_close_matches
from functools import cache
from importlib.metadata import EntryPoint, entry_points
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
PLACES = (
    *("chamber", "both chambers", "edge", "all valves"),
    *("command", "sensor", "supply", "state", "port", "motion"),
)
PLUGINS = "rtid.effects"  # entry points of other packages: a package with pages, or an effect
FUNCTION = "flow"  # in the equation of an effect in Python: what its function gives
SPREAD = 3  # values over its range where a search begins, for a parameter that names none


class EffectError(RtidError):
    """An effect that does not exist or cannot be used."""

    exit_code = 2


@dataclass(frozen=True)
class Parameter:
    """A parameter: SI unit, plausible range [low, high], sign of a possible value (0: either).

    start: where a search for a nonlinear one begins; it is held at a single value.  over: the start
    is `count` values over the range that this signal has in the record, at least `least` wide, or
    `shares` of its width, as far as they are plausible.
    quantiles: of the pressures at its place, tried beside the start as far as they are plausible.
    scale: "volume" or "flow" of the machine that the range grows with, or "1/" before either; ""
    for a range that is the same for all.  size, plant_unit: what sets its size in a plant by
    equations, and its unit there.
    """

    name: str
    unit: str
    symbol: str
    low: float
    high: float
    sign: int
    meaning: str
    start: tuple[float, ...] = ()
    over: str = ""
    count: int = 0
    least: float = 0.0
    shares: tuple[float, ...] = ()
    quantiles: tuple[float, ...] = ()
    scale: str = ""
    size: str = ""
    plant_unit: str = ""

    @property
    def is_held(self) -> bool:
        """True for one that is never searched for."""
        return len(self.start) == 1


@dataclass(frozen=True)
class Symbol:
    """A quantity of an equation: its SI unit and what it is; value: of a constant."""

    name: str
    unit: str
    meaning: str
    value: float | None = None


@dataclass(frozen=True)
class Effect:
    """One effect: what its page says.

    equation: lines "left = right" in the language of `rtid.effects.expression`, with the notations
    ddt(z), lag(z, tau), delay(z, tau) and play(z, width) besides; symbols: all quantities in them
    that are not parameters.  places: where it may act.  signals: what must be measured.
    confounders: names of effects that look alike.  separates: the motion that tells them apart.
    visible_when: under which conditions it can be seen at all; `invisible` if a free map swallows
    it always.

    law: name of a law in `rtid.effects.laws` where the equation cannot be one; no_law: why it has
    none.  linear_about: the constant that is its size, about which a law is linear in it; a value
    of it is where a search begins.  quantities, spills: of the states of a plant by equations on
    which it may act, and if what it takes reaches others.  stands_on: declared sizes that its own
    size stands on; corrects: the declared size that it is an error of.  into: (chamber, sign) pairs
    of a user's effect, whose equation is in the names of his machine; function: its flow (view,
    **shape) -> (n,) in Python.
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
    law: str = ""
    no_law: str = ""
    linear_about: str = ""
    quantities: tuple[str, ...] = ()
    spills: bool = False
    stands_on: tuple[str, ...] = ()
    corrects: str = ""
    into: tuple[tuple[str, int], ...] = ()
    function: Callable[..., Any] | None = field(default=None, compare=False, repr=False)

    @property
    def size(self) -> Parameter:
        """The parameter that its column is multiplied by."""
        return self.parameters[0]

    @property
    def inner_size(self) -> float:
        """The size that its law is linear about, SI; 0 where it is linear in it."""
        return next((s.value or 0.0 for s in self.symbols if s.name == self.linear_about), 0.0)

    def at_size(self, size: float) -> Effect:
        """The same, its law linear about this size, SI; as it is where it is linear in it."""
        if not self.linear_about:
            return self
        own = {self.linear_about: size}
        symbols = (replace(s, value=own.get(s.name, s.value)) for s in self.symbols)
        return replace(self, symbols=tuple(symbols))

    @property
    def shapes(self) -> tuple[Parameter, ...]:
        """The nonlinear parameters that are searched for."""
        return tuple(p for p in self.parameters[1:] if not p.is_held)


@cache
def catalogue() -> Mapping[str, Effect]:
    """All effects by name, in the order of their kinds, then of their names: ours and plug-ins'.

    What one page says of another, that they look alike, is true of both.
    Raises EffectError for a plug-in that does not load, or whose effect takes a name that is taken.
    """
    order = list(KINDS)
    pages = {page.name: page for page in pages_in(files("rtid.effects") / "pages")}
    brought: dict[str, EntryPoint] = {}
    for plugin in entry_points(group=PLUGINS):
        for page in _plugged(plugin):
            if page.name in pages:
                raise _unfit(plugin, f"its effect {page.name!r} exists already")
            pages[page.name] = page
            brought[page.name] = plugin
    for name, plugin in brought.items():
        for other in pages[name].confounders:
            if other not in pages:
                raise _unfit(plugin, f"{name} looks like {other!r}, which is no effect")
    mutual = [replace(page, confounders=_alike(page, pages)) for page in pages.values()]
    ordered = sorted(mutual, key=lambda page: (order.index(page.kind), page.name))
    return MappingProxyType({page.name: page for page in ordered})


def _alike(page: Effect, pages: Mapping[str, Effect]) -> tuple[str, ...]:
    """What looks like an effect: by its own page, and by theirs."""
    others = [name for name, other in pages.items() if page.name in other.confounders]
    return tuple(dict.fromkeys((*page.confounders, *others)))


def pages_in(folder: Any) -> Iterator[Effect]:
    """The pages of a folder, each named as its file.  EffectError names one that cannot be read."""
    symbols = files("rtid.effects") / "symbols.toml"
    common = tomllib.loads(symbols.read_text("utf-8"))
    for page in folder.iterdir():
        if page.name.endswith(".toml"):
            try:
                yield _read(page.name[:-5], tomllib.loads(page.read_text("utf-8")), common)
            except (ValueError, TypeError) as error:
                raise EffectError(f"the page {page} cannot be read: {error}", _REMEDY) from error
            except KeyError as error:
                raise EffectError(f"the page {page} lacks {error}", _REMEDY) from error


_REMEDY = "compare it with another page: the folder `rtid/effects/pages`"


def _plugged(plugin: EntryPoint) -> Iterator[Effect]:
    """What a plug-in brings: an effect, or all of a package: its pages, and what it has defined."""
    try:
        brought = plugin.load()
    except Exception as error:
        raise _unfit(plugin, f"it does not load: {error}") from error
    if isinstance(brought, Effect):
        yield brought
        return
    if hasattr(brought, "__path__"):
        yield from pages_in(files(brought))
    defined = (value for value in vars(brought).values() if isinstance(value, Effect))
    yield from {id(value): value for value in defined}.values()


def _unfit(plugin: EntryPoint, reason: str) -> EffectError:
    return EffectError(f"the plug-in {plugin.value}: {reason}", "correct or uninstall its package")


def correcting(size: str) -> tuple[Effect, ...]:
    """The effects that are an error of a declared size, "dead volume"; the size itself first."""
    pages = [page for page in catalogue().values() if page.corrects == size]
    return tuple(sorted(pages, key=lambda page: page.size.name not in size))


# as the pages call the declared sizes
DEAD_VOLUME, PRESSURE_ZERO = "dead volume", "zero of pressures"
OPENING = "command at which a valve opens"
ZERO = "zero of a pressure sensor"  # what is taken out of the samples, and no part of a fit


def is_zero(name: str) -> bool:
    """True for the effect that is an error of a sensor's zero."""
    return any(page.name == name for page in correcting(ZERO))


def effect(name: str) -> Effect:
    """The effect of that name; EffectError names the nearest."""
    if name not in catalogue():
        near = [known for known in catalogue() if name in known] if name else []
        near += get_close_matches(name, list(catalogue()), n=4, cutoff=0.5)
        hint = f"did you mean {' or '.join(dict.fromkeys(near))}?" if near else ""
        remedy = f"{hint} `rtid effects` lists all, with -p those of a project file too".strip()
        raise EffectError(f"there is no effect {name!r}", remedy)
    return catalogue()[name]


def _read(name: str, page: dict[str, Any], common: dict[str, str]) -> Effect:
    """One page from its TOML; `common` gives symbols ("unit: meaning") that many pages use."""
    page = {key: _tidy(value) for key, value in page.items()}
    named, constants = page.pop("symbols", {}), page.pop("constants", {})
    parameters = tuple(_parameter(entry) for entry in page.pop("parameters"))
    equation = tuple(page.pop("equation"))
    taken = {parameter.symbol for parameter in parameters}
    symbols = tuple(
        _symbol(word, named.get(word) or common.get(word, ""), constants.get(word))
        for word in words_of(equation)
        if word not in taken
    )
    lists: dict[str, Any] = {
        key: tuple(page.pop(key, ()))
        for key in ("places", "signals", "confounders", "quantities", "stands_on")
    }
    page = {"invisible": False} | page
    given = {*page, *lists, "name", "equation", "symbols", "parameters"}
    lacking = sorted(f.name for f in fields(Effect) if f.default is MISSING and f.name not in given)
    if lacking:
        raise ValueError(f"it lacks {', '.join(lacking)}")
    if page["kind"] not in KINDS:
        raise ValueError(f"its kind {page['kind']!r} is none of {', '.join(KINDS)}")
    return Effect(
        name=name, equation=equation, symbols=symbols, parameters=parameters, **lists, **page
    )


def _parameter(entry: dict[str, Any]) -> Parameter:
    """start: values; {from, to, count}, each a factor above the last; or {over, count, least}.

    Or {over, shares}.
    """
    entry = dict(entry)
    entry["quantiles"] = tuple(entry.pop("quantiles", ()))
    start = entry.pop("start", ())
    if isinstance(start, dict) and "over" in start:
        return Parameter(**entry, **start | {"shares": tuple(start.get("shares", ()))})
    if isinstance(start, dict):
        factor = (start["to"] / start["from"]) ** (1 / (start["count"] - 1))
        start = [start["from"] * factor**k for k in range(start["count"])]
    return Parameter(**entry, start=tuple(float(value) for value in start))


def _tidy(value: Any) -> Any:
    """A paragraph in one line."""
    return " ".join(value.split()) if isinstance(value, str) else value


NOTATION = ("ddt", "lag", "delay", "play")  # of an equation, besides the functions of an expression


def words_of(equation: tuple[str, ...]) -> tuple[str, ...]:
    """The quantities in the lines, in the order of their appearance."""
    words = [word for line in equation for word in re.findall(r"[A-Za-z_]\w*", line)]
    return tuple(dict.fromkeys(w for w in words if w not in FUNCTIONS and w not in NOTATION))


def _symbol(name: str, text: str, value: float | None) -> Symbol:
    unit, _, meaning = text.partition(":")
    return Symbol(name, unit.strip(), meaning.strip(), value)


def readable(line: str) -> str:
    """An equation as it is printed: d/dt, powers and products as on paper."""
    line = re.sub(r"\bddt\(", "d/dt(", line).replace(" * ", " · ")
    line = re.sub(r"\*\*(\w+)", r"^\1", line).replace("**", "^")
    line = re.sub(r"ssqrt\(([^()]*)\)", r"±√|\1|", line)
    return re.sub(r"d/dt\((\w+)\)", r"d\1/dt", line)


def title(name: str) -> str:
    """The effect's title, from its page where there is one."""
    page = catalogue().get(name)
    return page.title if page else name.replace("_", " ")
