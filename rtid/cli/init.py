"""`rtid init`: write a project file from a DBC or a table, with proposed roles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.cli.exits import Exit
from rtid.errors import RtidError

if TYPE_CHECKING:
    from rtid.project.proposal import Candidate

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
    from rtid.project.proposal import propose
    from rtid.project.template import project_text

    keys, candidates = _read(source, output.parent)
    roles = propose(candidates)
    used = {(c.message, c.name) for c in roles.values()}
    rest = [c for c in candidates if (c.message, c.name) not in used]
    output.write_text(project_text(output.stem, keys, roles, rest), "utf-8")
    print(f"wrote {output}")
    for role, found in roles.items():
        guessed = ", unit guessed" if found.guessed_unit else ""
        print(f"  {role:9} {f'{found.message}.{found.name}'.lstrip('.')} [{found.unit}{guessed}]")
    try:
        load(output)
        print("It is complete. Next: rtid check PROJECT TRACE")
    except ProjectError as error:
        print("Still missing:")
        for problem in error.problems:
            print(f"  {problem}")


def _read(source: str, folder: Path) -> tuple[dict[str, str], list[Candidate]]:
    """Keys of [source] and all signals."""
    from firmware_bridge import catalog
    from firmware_bridge.sources.table import read_table
    from rtid.project import proposal
    from rtid.project.table import is_table

    path = Path(source)
    if source == BUILTIN:
        return {"dbc": BUILTIN}, proposal.from_catalog(catalog.load())
    if not is_table(path):
        return {"dbc": proposal.relative(path, folder)}, proposal.from_catalog(catalog.load(path))
    table = read_table(path)
    time = proposal.time_column(table)
    if time is None:
        raise RtidError(f"{path}: no column looks like time", 'call it "t", in seconds')
    unit = table.units.get(time) or "s"
    return {"time_column": time, "time_unit": unit}, proposal.from_table(table)
