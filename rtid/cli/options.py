"""Options that several commands have in common, in the same words."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.exits import Exit
from rtid.errors import RtidError
from rtid.units import System, show_in


def _units(context: typer.Context, system: System) -> System:
    """What is printed from here to the end of the command is in these units."""
    show_in(system)
    context.call_on_close(lambda: show_in(System.DISPLAY))
    return system


def _kept(context: typer.Context, no_cache: bool) -> bool:
    """What is learned from here to the end of the command is kept beside the trace."""
    from rtid.study.kept import keeping

    context.with_resource(keeping(wanted=not no_cache))
    return no_cache


# Setting it is all: a command that has the option need not look at it.
UnitsOption = Annotated[
    System,
    typer.Option(
        "--units",
        callback=_units,
        help="What is printed: display (MPa, L/min, mm, ms) or si.  Files and JSON keep theirs.",
    ),
]


def _roles(texts: list[str] | None) -> list[str]:
    """Each is ROLE=NAME."""
    for text in texts or ():
        if not all(text.partition("=")):
            raise typer.BadParameter(f"{text!r} is not ROLE=COLUMN, u=valve_1")
    return texts or []


def by_role(texts: list[str]) -> dict[str, str]:
    """What `RoleOption` was given, by role."""
    return {role: name for role, _, name in (text.partition("=") for text in texts)}


RoleOption = Annotated[
    list[str] | None,
    typer.Option(
        "--role",
        callback=_roles,
        help="ROLE=COLUMN where a guess fails: u, x, p_a, p_b, p_supply, p_tank, v.",
    ),
]
TracesArgument = Annotated[
    list[Path],
    typer.Argument(
        help="CAN log or table.  Of several, one fit: the last one judges, or those that "
        "record.held_out of the project names."
    ),
]


def told_apart(
    files: list[Path], project: Path | None, command: str, most: int | None = 1
) -> tuple[list[Path], Path | None]:
    """Traces, at most so many, and project of a command, in any order: a project is a .toml."""
    projects = [f for f in files if f.suffix.lower() == ".toml"] + ([project] if project else [])
    traces = [f for f in files if f.suffix.lower() != ".toml"]
    if len(projects) > 1 or (most is not None and len(traces) > most):
        what = "more than one project" if len(projects) > 1 else f"more than {most} trace"
        remedy = f"rtid {command} TRACE -p PROJECT, the project a .toml"
        raise RtidError(what, remedy, Exit.USAGE)
    return traces, next(iter(projects), None)


ProjectOption = Annotated[Path, typer.Option("--project", "-p", help="Project file.")]
AnyProject = Annotated[Path | None, typer.Option("--project", "-p", help="Project file.")]
StateFolder = Annotated[
    Path | None, typer.Option("--state", help="State folder of the daemon; else the file's.")
]
TestBus = Annotated[
    bool, typer.Option("--test-bus", help="Allow udp_multicast and virtual: no authentication.")
]
Replace = Annotated[bool, typer.Option("--force", help="Replace an existing file.")]
PictureFormat = Annotated[str, typer.Option(help="png or svg.")]
PriorOption = Annotated[
    Path | None,
    typer.Option(
        "--prior",
        help="A map known before, for blocks without data: .npz or .json of `rtid export`, a data "
        "sheet (CSV), or a folder of `rtid fleet`; instead of the project file's section `prior`.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would be; write nothing.")]
Reason = Annotated[str, typer.Option(help="Why, for the history.")]
Where = Annotated[Path, typer.Argument(help="Project file, or the daemon's state folder.")]
NoCache = Annotated[
    bool,
    typer.Option(
        "--no-cache",
        callback=_kept,
        help="Learn anew, and keep nothing (what is learned is kept in .rtid beside the trace).",
    ),
]
