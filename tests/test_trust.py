"""A stranger's project: its Python runs after `rtid trust` alone, whatever the project says."""

from __future__ import annotations

import json
import os
import py_compile
from collections.abc import Callable
from pathlib import Path

import pytest

import rtid.project
from rtid.cli.exits import Exit
from rtid.project import ProjectError, load
from rtid.project.trust import NotTrustedError
from tests.command import ends

EXAMPLE = Path(rtid.project.__file__).parent / "examples" / "cylinder.toml"
EFFECT = """
from rtid.effects import define
@define("m3/s/Pa", chambers={"a": -1})
def leak(view):
    return view.p["p_a"]
"""
PLACES = ("own.py", "below/own.py", "./own.py", "below/../own.py")
OUTSIDE = ("../own.py", "/{outside}/own.py", "below/../../own.py", "link.py", "linked/own.py")


@pytest.fixture(autouse=True)
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user who has trusted nothing yet."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path / "config"


def stranger(folder: Path, name: str, code: str = EFFECT) -> tuple[Path, Path]:
    """A project that names this Python, and the file that the code writes if it ever runs."""
    ran, inside = folder / "ran", folder / "inside"
    code = f"open({str(ran)!r}, 'w').close()\n{code}"
    (inside / "below").mkdir(parents=True)
    for place in (folder, inside, inside / "below"):
        (place / "own.py").write_text(code)
    (inside / "link.py").symlink_to(folder / "own.py")
    (inside / "linked").symlink_to(folder)
    name = name.replace("/{outside}", str(folder))
    text = EXAMPLE.read_text().replace("[project]", f"[project]\neffects_module = '{name}'", 1)
    (inside / "project.toml").write_text(text)
    return inside / "project.toml", ran


CODES = {
    "an effect": EFFECT,
    "a syntax error": "def f(:\n",
    "an exit": "import sys; sys.exit(0)\n",
    "an endless loop": "while True: pass\n",
    "a coding line": "# coding: rot13\n",
}


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("name", PLACES)
def test_loading_a_strangers_project_runs_nothing(tmp_path: Path, name: str, code: str) -> None:
    file, ran = stranger(tmp_path, name, CODES[code])
    project = load(file)
    assert project.effects == () and project.untrusted is not None
    with pytest.raises(NotTrustedError, match="not trusted"):
        _ = project.all_effects
    assert not ran.exists()


@pytest.mark.parametrize("code", ["an effect", "an exit"])
@pytest.mark.parametrize("name", OUTSIDE)
def test_python_outside_the_projects_folder_is_refused(
    tmp_path: Path, name: str, code: str
) -> None:
    file, ran = stranger(tmp_path, name, CODES[code])
    ends("trust", tmp_path / "own.py")  # trusted or not
    with pytest.raises(ProjectError, match="lies outside the project's folder"):
        load(file)
    assert not ran.exists()


@pytest.mark.parametrize(
    "words",
    [
        ("status", "{file}"),
        ("apply", "{file}", "--log"),
        ("apply", "{file}", "--dry-run"),
        ("history", "-p", "{file}"),
        ("export", "{none}", "{out}", "-p", "{file}"),
        ("mcu", "c", "-p", "{file}", "--chamber", "a", "-o", "{out}"),
        ("check", "{file}", "{none}"),
        ("diagnose", "{none}", "-p", "{file}"),
        ("undo", "-p", "{file}"),
        ("accept", "{file}"),
    ],
    ids=lambda words: " ".join(w for w in words if "{" not in w),
)
def test_no_command_runs_it(tmp_path: Path, words: tuple[str, ...]) -> None:
    file, ran = stranger(tmp_path, "own.py")
    names = {"file": file, "none": tmp_path / "none.blf", "out": tmp_path / "out.csv"}
    ends(*(word.format(**names) for word in words))
    assert not ran.exists()


def test_trust_is_for_this_content_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, ran = stranger(tmp_path, "own.py")
    assert ends("trust", file) == Exit.OK and not ran.exists()
    assert [effect.name for effect in load(file).all_effects] == ["leak"] and ran.exists()
    python = file.with_name("own.py")
    trusted, when = python.read_text(), python.stat()
    ran.unlink()
    python.write_text(trusted.replace("leak", "lEAk"))  # as long as before
    os.utime(python, ns=(when.st_atime_ns, when.st_mtime_ns))
    assert load(file).untrusted == python and not ran.exists()
    python.write_text(trusted)
    assert load(file).untrusted is None
    assert ends("trust", "--forget", python) == Exit.OK
    assert load(file).untrusted == python
    assert "is not trusted any more" in capsys.readouterr().out


def test_a_compiled_file_beside_a_trusted_one_is_not_taken(tmp_path: Path) -> None:
    """Python's own import would: it looks at the time and the length of the source alone."""
    file, _ = stranger(tmp_path, "own.py")
    python, poisoned = file.with_name("own.py"), tmp_path / "poisoned"
    honest, when = python.read_text(), python.stat()
    python.write_text(f"open({str(poisoned)!r}, 'w')\n".ljust(len(honest), "#"))
    os.utime(python, ns=(when.st_atime_ns, when.st_mtime_ns))
    py_compile.compile(str(python))
    python.write_text(honest)
    os.utime(python, ns=(when.st_atime_ns, when.st_mtime_ns))
    assert ends("trust", file) == Exit.OK
    assert load(file).all_effects and not poisoned.exists()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda store: store.write_bytes(b"\xff\x00"),
        lambda store: store.write_text("\n\n"),
        lambda store: (store.unlink(), store.mkdir()),
        lambda store: store.unlink(),
    ],
)
def test_a_damaged_store_trusts_nothing(
    tmp_path: Path, settings: Path, spoil: Callable[[Path], object]
) -> None:
    file, ran = stranger(tmp_path, "own.py")
    assert ends("trust", file) == Exit.OK
    spoil(settings / "rtid" / "trusted")
    assert load(file).untrusted is not None and not ran.exists()


def test_a_store_in_the_projects_own_folder_counts_for_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, ran = stranger(tmp_path, "own.py")
    assert ends("trust", file) == Exit.OK
    (tmp_path / "config").rename(file.parent / "config")
    monkeypatch.chdir(file.parent)
    monkeypatch.setenv("XDG_CONFIG_HOME", "config")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load(file).untrusted is not None and not ran.exists()


def test_a_command_that_needs_it_says_how_to_trust(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, ran = stranger(tmp_path, "own.py")
    trace = tmp_path / "trace.csv"
    trace.write_text("t\n0\n")
    assert ends("add", "leak", trace, "-p", file) == Exit.USAGE
    told = capsys.readouterr().err
    assert "is not run" in told and f"rtid trust {file.with_name('own.py')}" in told
    assert not ran.exists()


def test_the_schema_of_a_project_has_no_other_door(tmp_path: Path) -> None:
    """A formula is read: what is no arithmetic is refused by name."""
    for flow in ("__import__('os')", "open('x')", "p_a.__class__", "(lambda: 1)()", "[p_a][0]"):
        more = f"[effects.e]\nflow = {json.dumps(flow)}\nunit = 'm3/s/Pa'\nchambers = {{a = -1}}\n"
        (tmp_path / "project.toml").write_text(EXAMPLE.read_text() + "\n" + more)
        with pytest.raises(ProjectError, match=r"effects\.e\.flow"):
            load(tmp_path / "project.toml")
