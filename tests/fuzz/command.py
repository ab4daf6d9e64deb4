"""One command line of rtid inside this process: what it printed, how it ended, what it raised."""

from __future__ import annotations

import contextlib
import io
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

from rtid.cli.main import run


@dataclass(frozen=True)
class Outcome:
    """How one command ended; `raised`: the traceback that a user would have seen, else ""."""

    code: int
    out: str
    err: str
    raised: str = ""


def call(arguments: Sequence[str]) -> Outcome:
    """Run `rtid ARGUMENTS`; everything that escapes it is a traceback, warnings go to stderr."""
    out, err = io.StringIO(), io.StringIO()
    raised, code = "", 1
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        warnings.resetwarnings()
        try:
            run(list(arguments))
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        except BaseException:
            raised = traceback.format_exc()
    return Outcome(code, out.getvalue(), err.getvalue(), raised)
