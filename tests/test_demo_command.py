"""What `rtid demo` prints at its end can be pasted into the shell that it was called from."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from inspect import signature
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from rich.console import Console

from rtid.cli import demo
from rtid.cli.main import COMMANDS
from rtid.sim.random_plants import draw
from rtid.study.demo import prepare

FOLDER = Path("my machines")  # with a space, as folders have
MACHINE = cast(
    Any,
    SimpleNamespace(trace=FOLDER / "machine.blf", project=SimpleNamespace(path=FOLDER / "m.toml")),
)


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with .venv/bin/rtid and a PATH on which no rtid is found."""
    monkeypatch.chdir(tmp_path)
    program = tmp_path / ".venv" / "bin" / "rtid"
    program.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m rtid "$@"\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr(sys, "argv", [".venv/bin/rtid", "demo"])
    return tmp_path


def commands(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The lines that are commands, as a narrow terminal gets them."""
    demo._print_next(Console(width=40), MACHINE, (FOLDER / "worn.blf", FOLDER / "worn.toml"))
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    return [line for line in lines if "machines" in line]


def test_as_it_was_called_where_rtid_is_not_on_the_path(
    shell: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = commands(capsys)
    assert len(lines) == 4
    for line in lines:
        program, command, *files = shlex.split(line)
        assert (program, command in COMMANDS) == (".venv/bin/rtid", True)
        assert {Path(f).parent for f in files if "." in f} == {FOLDER}
    called = lines[-1].partition(" ui ")[0]
    found = subprocess.run(
        ["/bin/sh", "-c", f"{called} --version"], capture_output=True, check=True
    )
    assert found.stdout.startswith(b"rtid ")


def test_plain_rtid_where_it_is_on_the_path(
    shell: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(shell / ".venv" / "bin"))
    assert shutil.which("rtid")
    assert all(line.startswith("rtid ") for line in commands(capsys))


def test_as_a_module(
    shell: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(shell / "rtid" / "__main__.py"), "demo"])
    assert all(line.startswith(f"{sys.executable} -m rtid ") for line in commands(capsys))


def test_the_sizes_of_readme_s_quick_are_those_of_the_demo() -> None:
    """Typed as it stood, it made a relief valve of the demo's worn machine."""
    readme = (Path(__file__).parents[1] / "README.md").read_text("utf-8")
    line = re.search(r"`rtid quick rtid-demo/worn.blf (--bore .*?) --save", readme)
    assert line
    bore, rod, stroke = (float(word) for word in line[1].split()[1::2])
    sizes = draw(signature(prepare).parameters["seed"].default).constants
    area = [np.pi / 400 * square for square in (bore**2, bore**2 - rod**2)]
    assert area == pytest.approx([1e4 * sizes.area_a_m2, 1e4 * sizes.area_b_m2], rel=5e-3)
    assert stroke == pytest.approx(1e3 * sizes.stroke_m, rel=1e-3)
