"""Exit codes of every rtid command: part of the contract, scripts rely on them."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from enum import IntEnum
from importlib.util import find_spec
from pathlib import Path

import typer

from rtid.errors import RtidError


class Exit(IntEnum):
    """What the exit code of `rtid` means."""

    OK = 0
    INTERNAL = 1  # an unexpected error inside rtid: a defect, please report it
    USAGE = 2  # wrong arguments, or a project file that is wrong
    INPUT = 3  # input that cannot be used: no wanted frame, an empty file, a wrong DBC
    NEGATIVE = 4  # the command worked and its result is negative: `check` found problems
    INTERRUPTED = 130  # Ctrl-C


def refuse_truncated(trace: Path, counters: Mapping[str, int]) -> None:
    """End with INPUT, after the result, where a trace stops before its end: scripts must see it."""
    if counters.get("truncated"):
        print(
            f"{trace}: truncated: the log stops before its end; what stood before was used",
            file=sys.stderr,
        )
        raise typer.Exit(Exit.INPUT)


def refuse_without_bokeh() -> None:
    """RtidError where the pictures of page and report cannot be made."""
    if find_spec("bokeh") is None:
        raise RtidError("its pictures need bokeh", "pip install 'rtid[ui]'", Exit.USAGE)
