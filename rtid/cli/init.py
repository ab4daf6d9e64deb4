"""`rtid init`: write a project file from a DBC or a table, with proposed roles."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.cli.exits import Exit
from rtid.cli.options import Replace, RoleOption, by_role
from rtid.errors import RtidError

if TYPE_CHECKING:
    from rtid.project.guess import RoleCandidate

BUILTIN = "builtin:controller.dbc"


def init(
    source: Annotated[str, typer.Argument(help=f"DBC, table, or {BUILTIN}.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write.")] = Path(
        "project.toml"
    ),
    role: RoleOption = None,
    force: Replace = False,
) -> None:
    """Write a commented project file and say what is still missing.

    Roles are proposed by unit and name; what only you know is marked TODO.  A table without
    pressures gives the complete file of a plant whose rate follows a command, or of one by its
    equations where it empties or cools down by itself.
    """
    if output.exists() and not force:
        raise RtidError(f"{output} exists", "give another -o, or --force", Exit.USAGE)
    from rtid.project import ProjectError, load
    from rtid.project.guess import named, propose, unused, with_named
    from rtid.project.template import project_text

    keys, candidates = _read(source, output.parent)
    given = named(candidates, by_role(role or []))
    roles = with_named(propose(candidates), given)
    if "time_column" in keys and _write_rate(
        Path(source), output, given, bool({"p_a", "p_b"} & roles.keys())
    ):
        return
    rest = unused(candidates, roles)
    output.write_text(project_text(output.stem, keys, roles, rest), "utf-8")
    print(f"wrote {output}")
    for played, candidate in roles.items():
        guessed = ", unit guessed" if candidate.guessed_unit else ""
        print(f"  {played:9} {candidate.full_name} [{candidate.unit}{guessed}]")
    if rest:
        print(f"Not used: {', '.join(c.full_name for c in rest)}")
    try:
        load(output)
        print("It is complete. Next: rtid check TRACE -p PROJECT")
    except ProjectError as error:
        print("Still missing:")
        for problem in error.problems:
            print(f"  {problem}")


def _write_rate(
    table: Path, output: Path, given: Mapping[str, RoleCandidate], has_pressures: bool
) -> bool:
    """The file of a plant without pressures, or of a pump that drives; False where it is none."""
    from rtid.study.quick_plant import equations_of
    from rtid.study.rate_pairs import driven_pairs, pairs_of
    from rtid.study.rate_project import rate_text
    from rtid.trace.quick_source import open_source

    opened = open_source(table, None)
    if not has_pressures and (found := equations_of(table, opened, given)):
        output.write_text(found.text, "utf-8")
        print(f"wrote {output}: {found.structure.words}, by its equations")
        for name, signal in found.pair.roles.items():
            print(f"  {name:9} {signal.full_name} [{signal.unit or '?'}]")
        print(f"It is complete. Next: rtid refit {output} {table} --diagnose")
        return True
    pairs = (driven_pairs if has_pressures else pairs_of)(table, opened, given)
    if not pairs:
        return False
    output.write_text(rate_text(output.stem, table, opened, pairs[0]), "utf-8")
    print(f"wrote {output}: {pairs[0].kind}, {pairs[0].equation}")
    for name, signal in pairs[0].roles.items():
        print(f"  {name:9} {signal.full_name} [{signal.unit}]")
    used = {signal.name for signal in pairs[0].roles.values()}
    if rest := [s.full_name for s in opened.signals if s.name not in used]:
        print(f"Not used: {', '.join(rest)}")
    for other in pairs[1:]:
        print(f"There is another pair: {other.options}")
    print(f"It is complete. Next: rtid diagnose {table} -p {output}")
    return True


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
