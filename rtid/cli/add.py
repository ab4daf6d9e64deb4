"""`rtid add`: make a missing effect part of the model, and see the error fall."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.exits import refuse_truncated
from rtid.cli.options import AsJson, DryRun, NoCache, ProjectOption, Reason, UnitsOption
from rtid.errors import RtidError
from rtid.units import System


def add(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="[EFFECT[:WHERE]] TRACE...",
            help="TRACE: CAN log or table, or several.  EFFECT: without it what `rtid diagnose` "
            "names.",
        ),
    ],
    project: ProjectOption,
    force: Annotated[
        bool, typer.Option("--force", help="Add it even if the held-out error does not fall.")
    ] = False,
    dry_run: DryRun = False,
    reason: Reason = "",
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
    no_cache: NoCache = False,
) -> None:
    """Refit with one effect more, show both errors before and after, and write it to the project.

    The project file keeps its comments; `rtid undo` restores it byte for byte.
    """
    name, traces = (
        ("", words) if len(words) == 1 or Path(words[0]).exists() else (words[0], words[1:])
    )
    for trace in traces:
        if not Path(trace).exists():
            raise RtidError(f"{trace}: no such file", "rtid add [EFFECT[:WHERE]] TRACE -p PROJECT")
    from rtid.study.revisions import add as add_effect
    from rtid.tell.replay import progress_bar
    from rtid.tell.revised import show

    effect, _, where = name.partition(":")
    with progress_bar() as progress:
        done = add_effect(
            project, traces, effect, where,
            force=force, dry_run=dry_run, reason=reason, progress=progress,
        )  # fmt: skip
    show(done, as_json, trace=traces[0])
    refuse_truncated(Path(traces[0]), done.counters)
