"""The command line in this process, as tests call it: any end but an exit is an error."""

from __future__ import annotations

import io
import json
import subprocess
from contextlib import redirect_stderr, redirect_stdout
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from rtid.cli import main
from rtid.cli.exits import Exit


def ends(*words: object) -> int:
    """Its exit code."""
    with pytest.raises(SystemExit) as ended:
        main.run([str(word) for word in words])
    return int(ended.value.code or 0)


def said(*words: object) -> tuple[int, str, str]:
    """Its exit code, and what it wrote to stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = ends(*words)
    return code, out.getvalue(), err.getvalue()


def in_json(*words: object, code: int = Exit.OK) -> Any:
    """What a command with --json says that ends with this code."""
    ended, out, err = said(*words, "--json")
    assert ended == code, err
    return json.loads(out)


def output_of(app: typer.Typer, *words: object) -> str:
    """What a command writes that must not fail, called as a function: its errors are raised."""
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def called(*words: object) -> subprocess.CompletedProcess[str]:
    """The same as of a process."""
    return subprocess.CompletedProcess([*map(str, words)], *said(*words))
