"""`rtid effects`: the catalogue of physical effects, and one page of it."""

from __future__ import annotations

import json
import textwrap
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.units import PRACTICAL

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from rtid.effects import Effect, Parameter

WIDTH = 100
INDENT = 2
SCHEMA = 1


def effects(
    name: Annotated[str, typer.Argument(help="An effect; all are listed without it.")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON, SI units.")] = False,
) -> None:
    """List the physical effects that `rtid diagnose` knows, or explain one."""
    from rtid.effects import catalogue, effect

    if name:
        page = effect(name)
        print(json.dumps({"schema": SCHEMA} | asdict(page))) if as_json else _print_page(page)
        return
    if as_json:
        print(json.dumps({"schema": SCHEMA, "effects": [asdict(e) for e in catalogue().values()]}))
        return
    _print_list()


def _console() -> Console:
    from rich.console import Console

    console = Console(highlight=False)
    return Console(
        highlight=False, width=min(console.width, WIDTH) if console.is_terminal else WIDTH
    )


def _print_list() -> None:
    from rtid.effects import catalogue
    from rtid.effects.page import KINDS

    console = _console()
    for kind, meaning in KINDS.items():
        group = [e for e in catalogue().values() if e.kind == kind]
        console.print(f"\n[bold]{kind}[/bold]: {meaning}")
        console.print(_group(group))
    console.print(
        "\nrtid effects NAME explains one.  Your own: \\[effects.NAME] in the project file."
    )


def _group(group: list[Effect]) -> Table:
    from rich.table import Table

    from rtid.effects import catalogue

    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(min_width=INDENT + max(len(name) for name in catalogue()))
    table.add_column(min_width=44)
    table.add_column()
    for effect in group:
        table.add_row("  " + effect.name, effect.title, ", ".join(effect.places))
    return table


def _print_page(page: Effect) -> None:
    from rtid.effects.page import readable

    console = _console()
    console.print(f"[bold]{page.title}[/bold]  ({page.name})")
    _paragraph(console, page.summary)
    console.print(f"\n[bold]Kind[/bold]     {page.kind}; acts on: {', '.join(page.places)}")
    console.print(f"[bold]Signals[/bold]  {', '.join(page.signals)}")
    console.print("\n[bold]Equation[/bold]")
    for line in page.equation:
        console.print(f"    {readable(line)}", markup=False, soft_wrap=True)
    console.print()
    console.print(_symbols(page))
    console.print("\n[bold]Parameters[/bold]")
    for parameter in page.parameters:
        _print_parameter(console, parameter)
    if page.invisible:
        console.print("\n[bold]Structurally invisible[/bold]: a free flow map swallows it.")
    for title, text in (
        ("In the residual", page.signature),
        ("Looks like", ", ".join(page.confounders)),
        ("What tells them apart", page.separates),
        ("Visible when", page.visible_when),
        ("Reference", page.reference),
    ):
        console.print(f"\n[bold]{title}[/bold]")
        _paragraph(console, text)


def _paragraph(console: Console, text: str, indent: int = INDENT) -> None:
    width = console.width - indent - INDENT
    lines = textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)
    console.print(textwrap.indent("\n".join(lines), " " * indent), markup=False)


def _symbols(page: Effect) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(min_width=12)
    table.add_column(min_width=10)
    table.add_column()
    for symbol in page.symbols:
        table.add_row(Text("    " + symbol.name), Text(symbol.unit), Text(symbol.meaning))
    for word, meaning in NOTATION.items():
        if any(word + "(" in line for line in page.equation):
            table.add_row(Text("    " + word), Text(""), Text(meaning))
    return table


NOTATION = {
    "pos": "pos(z) = max(0, z)",
    "ssqrt": "ssqrt(z) = sign(z) sqrt|z|",
    "delay": "delay(z, T): z at the time t - T",
    "play": "play(z, h): z behind a play of full width h",
}


def _print_parameter(console: Console, p: Parameter) -> None:
    sign = {1: "positive", -1: "negative", 0: "of either sign"}[p.sign]
    span = f"{p.low:g} to {p.high:g} {'' if p.unit == '1' else p.unit}".strip()
    if p.unit in PRACTICAL and not (p.unit in ("m", "s") and p.high >= 1):
        unit, factor = PRACTICAL[p.unit]
        span += f" ({p.low * factor:.3g} to {p.high * factor:.3g} {unit})"
    _paragraph(console, f"{p.name}, {p.symbol}: {span}, {sign}")
    _paragraph(console, p.meaning, 3 * INDENT)
