"""`make check` runs what a change touches, nearest first, and nothing that starts a process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tools import unit_tests
from tools.touched import Sources, changed

FILES = {
    "rtid/__init__.py": "from rtid.deep import dive as plunge\n",
    "rtid/deep.py": "def dive(): ...\n",
    "rtid/shallow.py": "def wade():\n    from rtid.deep import dive\n    dive()\n",
    "rtid/apart.py": "TABLE = 'sheet.csv'\n",
    "tests/test_deep.py": "from rtid import plunge\n",
    "tests/test_a_shallow.py": "import rtid.shallow\n",
    "tests/test_apart.py": "from rtid import apart\n",
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("file", "reached"),
    [
        ("rtid/deep.py", {"test_deep.py": 1, "test_a_shallow.py": 2}),  # and not who imports rtid
        ("rtid/apart.py", {"test_apart.py": 1}),
        ("sheet.csv", {"test_apart.py": 1}),  # a module says its name
        ("rtid/shallow.py", {"test_a_shallow.py": 1}),
        ("rtid/__init__.py", {"test_apart.py": 0, "test_deep.py": 0}),
        ("tests/test_deep.py", {"test_deep.py": 0}),
        ("LICENSE", {}),
    ],
)
def test_a_change_reaches_those_who_import_it(
    root: Path, file: str, reached: dict[str, int]
) -> None:
    near = Sources(root).tests([root / file])
    assert [(path.name, distance) for path, distance in near.items()] == list(reached.items())


def test_what_is_not_yet_committed_is_a_change(root: Path) -> None:
    def git(*words: str) -> None:
        who = ("-c", "user.name=x", "-c", "user.email=x@example.org")
        subprocess.run(["git", *who, *words], cwd=root, check=True, capture_output=True)

    git("init", "-b", "main")
    git("add", ".")
    git("commit", "-m", "all")
    assert changed(root) == []
    (root / "rtid" / "deep.py").write_text("def dive(): return 1\n")
    (root / "new.py").touch()
    assert {path.name for path in changed(root)} == {"deep.py", "new.py"}


def test_what_starts_a_process_is_skipped_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    sys.audit("os.fork")  # nobody listens yet, or no test runs
    monkeypatch.setattr(unit_tests, "_running", True)
    with pytest.raises(pytest.skip.Exception, match="starts a process"):
        unit_tests._refuse("subprocess.Popen", ("ls",))
    unit_tests._refuse("open", ("file",))
