"""The wheel in an empty virtual environment, from the registry, with no compiler on the path."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tools.wheel import build

pytestmark = pytest.mark.campaign


def test_the_demo_runs_where_nothing_else_is_installed(tmp_path: Path) -> None:
    wheel, venv, place = build(tmp_path), tmp_path / "venv", tmp_path / "empty"
    place.mkdir()
    bare = {"HOME": str(tmp_path), "PATH": "/nonexistent"}  # no compiler, no git, no shell

    def run(*command: object) -> str:
        words = [str(word) for word in command]
        done = subprocess.run(
            words, cwd=place, env=bare, stdout=subprocess.PIPE, text=True, check=True
        )
        return done.stdout

    run(sys.executable, "-m", "venv", venv)
    run(venv / "bin" / "pip", "-q", "install", "--only-binary", ":all:", wheel)
    told = run(venv / "bin" / "rtid", "demo", "--duration", "30")
    assert "bulk modulus, chamber a" in told
    assert (place / "rtid-demo" / "worn.toml").is_file()
