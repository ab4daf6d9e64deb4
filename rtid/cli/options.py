"""Options that several commands have in common, in the same words."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ProjectOption = Annotated[Path, typer.Option("--project", "-p", help="Project file.")]
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
