"""That tests leave nothing behind and do not hang is itself tested: both nets catch."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests import left
from tests.left import Here, left_since

ROOT = Path(__file__).parents[1]
HANGS = """
import time

def test_hangs():
    while True:
        time.sleep(0.01)

def test_hangs_again():  # what catches the first alarm must not go on for ever
    for _ in range(2):
        try:
            while True:
                time.sleep(0.01)
        except BaseException:
            again = True
    raise AssertionError("ended twice")

def test_passes():
    pass
"""


def test_all_that_is_left_behind_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(left, "PATIENCE_S", 0.2)
    before, over = Here.now(tmp_path), threading.Event()
    assert left_since(before, tmp_path) == []
    thread = threading.Thread(target=over.wait, name="a thread")
    with subprocess.Popen(["sleep", "60"]) as process, socket.socket():
        thread.start()
        (tmp_path / "a file").touch()
        found = left_since(before, tmp_path)
        process.kill()
    over.set()
    thread.join()
    text = "; ".join(found)
    assert len(found) == 4, text
    for what in ("thread a thread", "sleep 60", "open socket", "a file"):
        assert what in text


def test_a_test_that_hangs_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(
        "from tests.conftest import pytest_timeout_set_timer\n"
        "import tests.conftest\ntests.conftest.AGAIN_S = 2.0\n"
    )
    (tmp_path / "test_hanging.py").write_text(HANGS)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:benchmark", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, "-c", str(ROOT / "pyproject.toml"), "--rootdir", str(tmp_path), str(tmp_path),
         "-o", "timeout=1"],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert "Failed: Timeout (>1.0s)" in done.stdout and "ended twice" in done.stdout, done.stdout
    for name in ("test_hangs", "test_hangs_again"):  # where CI is set pytest adds the message
        assert re.search(rf"^FAILED \S*test_hanging\.py::{name}( - .*)?$", done.stdout, re.M)
    assert "2 failed, 1 passed" in done.stdout


def test_every_test_has_a_time_limit(pytestconfig: pytest.Config) -> None:
    assert 0 < float(pytestconfig.getini("timeout")) <= 900
