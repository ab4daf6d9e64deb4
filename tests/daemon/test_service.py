"""The unit file's sandbox, and what the commands refuse."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

import rtid.daemon
from rtid.daemon.status import read, write
from tests.daemon.test_parts import full_status

UNIT = Path(rtid.daemon.__file__).with_name("rtid@.service")
PROJECT = Path(rtid.__file__).parent / "project" / "examples" / "cylinder.toml"


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "rtid", *arguments], capture_output=True, text=True, check=False
    )


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_the_unit_is_sandboxed(tmp_path: Path) -> None:
    unit = tmp_path / "rtid@boom.service"
    unit.write_text(UNIT.read_text("utf-8"), "utf-8")
    said = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", str(unit)],
        capture_output=True, text=True, check=False,
    ).stdout  # fmt: skip
    found = re.search(r"exposure level[^:]*: ([0-9.]+)", said)
    assert found is not None, said
    print(f"\nexposure {found[1]}")
    assert float(found[1]) <= 3.0


def test_the_unit_waits_for_samples_and_is_watched() -> None:
    text = UNIT.read_text("utf-8")
    for line in (
        "Type=notify",
        "WatchdogSec=5",
        "Restart=always",
        "KillMode=mixed",
        "TimeoutStartSec=infinity",
    ):
        assert line in text


def test_a_test_bus_needs_a_word(tmp_path: Path) -> None:
    found = command("run", str(PROJECT), "--bus", "udp_multicast:239.74.1.1",
                    "--state", str(tmp_path))  # fmt: skip
    assert found.returncode == 2 and "--test-bus" in found.stderr
    assert not list(tmp_path.iterdir())


def test_a_bus_that_cannot_be_opened_is_a_plain_error(tmp_path: Path) -> None:
    found = command("run", str(PROJECT), "--bus", "slcan:/dev/no_such_port", "--state",
                    str(tmp_path / "state"))  # fmt: skip
    assert found.returncode == 3, found.stderr
    assert "/dev/no_such_port" in found.stderr and "Traceback" not in found.stderr


def test_a_stop_before_the_bus_is_open_is_heard(tmp_path: Path) -> None:
    """SIGTERM while kernels are being loaded."""
    process = subprocess.Popen(
        [sys.executable, "-m", "rtid", "run", str(PROJECT), "--bus", "virtual:stop", "--test-bus",
         "--state", str(tmp_path)],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    while not (tmp_path / "lock").exists():
        assert process.poll() is None
        time.sleep(0.01)
    process.terminate()
    _, said = process.communicate(timeout=120)
    assert process.returncode == 0 and "stopped" in said


def test_status_of_no_daemon(tmp_path: Path) -> None:
    found = command("status", str(tmp_path))
    assert found.returncode == 3 and "rtid run" in found.stderr


def test_status_of_a_daemon_that_has_ended(tmp_path: Path) -> None:
    write(tmp_path, full_status())
    found = command("status", str(tmp_path))
    assert found.returncode == 4 and "NOT RUNNING" in found.stdout
    assert command("status", str(tmp_path), "--json").stdout.strip() == read(tmp_path).to_json()
