"""A command that takes long shows what it does on a terminal's stderr, and nothing elsewhere."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.replays import shared_replays  # noqa: F401


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("progress")
    write_run(path / "run.parquet", simulate(SimulatedPlant(), "rich", 3, 3.0), 3, "rich")
    return path


COMMANDS = {
    "check": (["check", "run.toml", "run.parquet", "--json"], "learning the maps"),
    "compare": (["compare", "run.parquet", "-p", "run.toml", "--json"], "examining the maps"),
    "export": (["export", "run.parquet", "map.csv", "-p", "run.toml"], "learning the maps"),
}


def on_terminal(words: list[str], folder: Path) -> str:
    """What a command writes to a stderr that is a terminal of 80 columns."""
    ours, theirs = pty.openpty()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "80"}
    with subprocess.Popen(
        [sys.executable, "-m", "rtid", *words],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=theirs,
    ) as process:
        os.close(theirs)
        shown = b""
        try:
            while part := os.read(ours, 4096):
                shown += part
        except OSError:  # Linux tells the end of a terminal by EIO
            pass
        finally:
            os.close(ours)
        assert process.wait(60) in (0, 4)
    return shown.decode(errors="replace")


@pytest.mark.first_of(1)
@pytest.mark.parametrize("name", list(COMMANDS))
def test_what_is_being_done_is_shown_on_a_terminal(folder: Path, name: str) -> None:
    words, step = COMMANDS[name]
    assert step in on_terminal(words, folder)


@pytest.mark.long
def test_nothing_is_shown_where_there_is_no_terminal(folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "rtid", *COMMANDS["check"][0]],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stderr == ""
