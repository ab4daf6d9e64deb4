"""`rtid drop`: take an effect out of the model again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.exits import refuse_truncated
from rtid.cli.options import AsJson, DryRun, NoCache, ProjectOption, Reason, UnitsOption
from rtid.units import System


def drop(
    effect: Annotated[str, typer.Argument(metavar="EFFECT[:WHERE]", help="An added effect.")],
    project: ProjectOption,
    trace: Annotated[
        Path | None, typer.Argument(help="CAN log or table: also say what it costs.")
    ] = None,
    dry_run: DryRun = False,
    reason: Reason = "",
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
    no_cache: NoCache = False,
) -> None:
    """Take an effect out of the project's model; with a trace, show errors before and after."""
    from rtid.study.revisions import drop as drop_effect
    from rtid.tell.replay import progress_bar
    from rtid.tell.revised import show

    name, _, where = effect.partition(":")
    with progress_bar(hidden=trace is None) as progress:
        done = drop_effect(
            project, name, where, trace, dry_run=dry_run, reason=reason, progress=progress
        )
    show(done, as_json)
    if trace is not None:
        refuse_truncated(trace, done.counters)
