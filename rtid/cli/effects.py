"""`rtid effects`: the catalogue of physical effects, and one page of it."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtid.cli.options import UnitsOption
from rtid.plain import plain
from rtid.units import System, range_of

if TYPE_CHECKING:
    from rich.console import Console

    from rtid.effects import Effect, Parameter
    from rtid.tell.story import Table

WIDTH = 100
INDENT = 2
SCHEMA = 1


def effects(
    name: Annotated[str, typer.Argument(help="An effect; all are listed without it.")] = "",
    project: Annotated[
        Path | None, typer.Option("--project", "-p", help="Project file: its own effects too.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON, SI units.")] = False,
    units: UnitsOption = System.DISPLAY,
) -> None:
    """List the physical effects that `rtid diagnose` knows, or explain one."""
    from rtid.effects import catalogue, effect

    known = {**catalogue(), **_own(project)}
    if name:
        page = known.get(name) or effect(name)
        print(json.dumps({"schema": SCHEMA} | _plain(page))) if as_json else _print_page(page)
        return
    if as_json:
        print(json.dumps({"schema": SCHEMA, "effects": [_plain(e) for e in known.values()]}))
        return
    _print_list(known)


def _own(project: Path | None) -> dict[str, Effect]:
    """What a project file brings, by name."""
    if project is None:
        return {}
    from rtid.project import load

    return {effect.name: effect for effect in load(project).all_effects}


def _places(effect: Effect) -> str:
    """Where it acts; an effect of a user's at one place, by its chambers."""
    from rtid.effects.law import place_of

    chambers = [name for name, _ in effect.into]
    return place_of(effect.into, chambers) if chambers else ", ".join(effect.places)


def _plain(page: Effect) -> dict[str, Any]:
    """What its page says, in plain JSON types."""
    return dict(plain(replace(page, function=None)))


def _console() -> Console:
    from rtid.tell.terminal import make_console

    console = make_console()
    console.width = min(console.width, WIDTH)
    return console


def _print_list(known: Mapping[str, Effect]) -> None:
    from rtid.effects.page import KINDS

    console = _console()
    for kind, meaning in KINDS.items():
        group = [e for e in known.values() if e.kind == kind]
        _heading(console, f"\n{kind}", f": {meaning}")
        console.print(_group(group))
    console.print(
        "\nrtid effects NAME explains one.  Your own: [effects.NAME] in the project file."
    )


def _group(group: list[Effect]) -> Table:
    from rtid.tell.story import Table

    rows = [("  " + effect.name, effect.title, _places(effect)) for effect in group]
    return Table("", ("", "~", "~"), rows)


def _print_page(page: Effect) -> None:
    from rtid.effects.page import readable

    console = _console()
    _heading(console, page.title, f"  ({page.name})")
    _paragraph(console, page.summary if page.summary != page.title else "")
    _heading(console, "\nKind", f"     {page.kind}; acts on: {_places(page)}")
    if page.signals:
        _heading(console, "Signals", f"  {', '.join(page.signals)}")
    _heading(console, "\nEquation")
    for line in page.equation:
        console.print(f"    {readable(line)}", soft_wrap=True)
    console.print()
    console.print(_symbols(page))
    _heading(console, "\nParameters")
    for parameter in page.parameters:
        _print_parameter(console, parameter)
    if page.invisible:
        _heading(console, "\nStructurally invisible", ": a free flow map swallows it.")
    for title, text in (
        ("In the residual", page.signature),
        ("Looks like", ", ".join(page.confounders)),
        ("What tells them apart", page.separates),
        ("Visible when", page.visible_when),
        ("Reference", page.reference),
    ):
        if text:  # a formula of a project says no more than itself
            _heading(console, f"\n{title}")
            _paragraph(console, text)


def _heading(console: Console, words: str, rest: str = "") -> None:
    from rich.text import Text

    console.print(Text.assemble((words, "bold"), rest))


def _paragraph(console: Console, text: str, indent: int = INDENT) -> None:
    if not text:
        return
    width = console.width - indent - INDENT
    lines = textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)
    console.print(textwrap.indent("\n".join(lines), " " * indent))


def _symbols(page: Effect) -> Table:
    from rtid.tell.story import Table

    rows = [("    " + symbol.name, symbol.unit, symbol.meaning) for symbol in page.symbols]
    rows += [
        ("    " + word, "", meaning)
        for word, meaning in NOTATION.items()
        if any(word + "(" in line for line in page.equation)
    ]
    return Table("", ("", "", "~"), rows, keys=2)


NOTATION = {
    "pos": "pos(z) = max(0, z)",
    "ssqrt": "ssqrt(z) = sign(z) sqrt|z|",
    "delay": "delay(z, T): z at the time t - T",
    "play": "play(z, h): z behind a play of full width h",
}


def _print_parameter(console: Console, p: Parameter) -> None:
    sign = {1: "positive", -1: "negative", 0: "of either sign"}[p.sign]
    span = range_of(p.low, p.high, p.unit)
    _paragraph(console, f"{p.name}, {p.symbol}: {span}, {sign}")
    _paragraph(console, p.meaning, 3 * INDENT)
