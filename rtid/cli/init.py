"""`rtid init`: write a project file from a DBC or a table, with proposed roles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.cli.exits import Exit
from rtid.errors import RtidError

if TYPE_CHECKING:
    from rtid.project.guess import RoleCandidate

BUILTIN = "builtin:controller.dbc"


def init(
    source: Annotated[str, typer.Argument(help=f"DBC, table, or {BUILTIN}.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write.")] = Path(
        "project.toml"
    ),
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Write a commented project file and say what is still missing.

    Roles are proposed by unit and name; what only you know is marked TODO.
    """
    if output.exists() and not force:
        raise RtidError(f"{output} exists", "give another -o, or --force", Exit.USAGE)
    from rtid.project import ProjectError, load
    from rtid.project.guess import propose, unused
    from rtid.project.template import project_text

    keys, candidates = _read(source, output.parent)
    roles = propose(candidates)
    rest = unused(candidates, roles)
    output.write_text(project_text(output.stem, keys, roles, rest), "utf-8")
    print(f"wrote {output}")
    for role, candidate in roles.items():
        guessed = ", unit guessed" if candidate.guessed_unit else ""
        print(f"  {role:9} {candidate.full_name} [{candidate.unit}{guessed}]")
    if rest:
        print(f"Not used: {', '.join(c.full_name for c in rest)}")
    try:
        load(output)
        print("It is complete. Next: rtid check PROJECT TRACE")
    except ProjectError as error:
        print("Still missing:")
        for problem in error.problems:
            print(f"  {problem}")


def _read(source: str, folder: Path) -> tuple[dict[str, str], list[RoleCandidate]]:
    """Keys of [source] and all signals."""
    from firmware_bridge import catalog
    from firmware_bridge.sources import read_table
    from firmware_bridge.sources.formats import format_of
    from rtid.project import guess as proposal
    from rtid.trace.table import time_of

    path = Path(source)
    if source == BUILTIN:
        return {"dbc": BUILTIN}, proposal.from_catalog(catalog.load())
    if format_of(path) is None:
        places = catalog.places(source)
        candidates = proposal.from_catalog(catalog.load(places))
        names = [place.named(proposal.relative(place.file, folder)) for place in places]
        return {"dbc": ", ".join(names)}, candidates
    table = read_table(path)
    time, unit = time_of(table)
    return {"time_column": time, "time_unit": unit}, proposal.from_table(table)
