"""`rtid diagnose`: which physical effect is missing in the model of a captured trace."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.exits import refuse_truncated
from rtid.cli.options import AsJson, ProjectOption


def diagnose(
    trace: Annotated[Path, typer.Argument(help="CAN log or table.")],
    project: ProjectOption,
    as_json: AsJson = False,
) -> None:
    """Say which physical effect is missing, how large it is, and what could not be seen.

    Verdicts: matches, missing (an effect has a name), ambiguous (one of a set), unknown (something
    is missing that no known effect explains), insufficient_data.
    """
    from rtid.diagnosed_text import show
    from rtid.diagnosing import diagnose_trace
    from rtid.present import progress_bar
    from rtid.project import load

    loaded = load(project)
    with progress_bar(hidden=as_json) as progress:
        found = diagnose_trace(loaded, trace, progress)
    if as_json:
        print(json.dumps({"trace": str(trace)} | found.diagnosis.as_json()))
    else:
        show(found.diagnosis)
    refuse_truncated(trace, found.trace.counters)
