"""The base of all errors that rtid raises for a reason that the user can mend."""

from __future__ import annotations


class RtidError(Exception):
    """A refusal in plain words: what is wrong and where, and `remedy`, what to do about it.

    The command line prints both and ends with `exit_code` (see `rtid.cli.exits`).
    """

    exit_code = 3

    def __init__(self, message: str, remedy: str = "", exit_code: int | None = None) -> None:
        super().__init__(message)
        self.remedy = remedy
        if exit_code is not None:
            self.exit_code = exit_code
