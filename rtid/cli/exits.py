"""Exit codes of every rtid command: part of the contract, scripts rely on them."""

from __future__ import annotations

from enum import IntEnum


class Exit(IntEnum):
    """What the exit code of `rtid` means."""

    OK = 0
    INTERNAL = 1  # an unexpected error inside rtid: a defect, please report it
    USAGE = 2  # wrong arguments, or a project file that is wrong
    INPUT = 3  # input that cannot be used: no wanted frame, an empty file, a wrong DBC
    NEGATIVE = 4  # the command worked and its result is negative: `check` found problems
    INTERRUPTED = 130  # Ctrl-C
