"""The unit file's sandbox, and what the commands refuse."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import rtid.daemon
from rtid.cli import main
from rtid.daemon.status import read, write
from tests.daemon.test_parts import full_status
from tests.left import children
from tests.left import command as command_of

UNIT = Path(rtid.daemon.__file__).with_name("rtid@.service")
Called = Callable[..., tuple[int, str, str]]
PROJECT = Path(rtid.__file__).parent / "project" / "examples" / "cylinder.toml"


@pytest.fixture
def called(capsys: pytest.CaptureFixture[str]) -> Called:
    """Exit code of a command line in this process, and what it printed on both streams."""

    def call(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            main.run(list(arguments))
        printed = capsys.readouterr()
        return int(end.value.code or 0), printed.out, printed.err

    return call


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "rtid", *arguments], capture_output=True, text=True, check=False
    )


# As shells start what they put into the background, and hangups are heard also where the tests
# themselves were started under nohup.
AS_A_JOB = (
    "import os, signal, sys\n"
    "signal.signal(signal.SIGINT, signal.SIG_IGN); signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
    "os.execv(sys.executable, [sys.executable, '-m', 'rtid', *sys.argv[1:]])"
)
WITHOUT_INTERRUPT = [sys.executable, "-c", AS_A_JOB]


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


def test_a_test_bus_needs_a_word(tmp_path: Path, called: Called) -> None:
    code, _, said = called("run", str(PROJECT), "--bus", "udp_multicast:239.74.1.1",
                           "--state", str(tmp_path))  # fmt: skip
    assert code == 2 and "--test-bus" in said
    assert not list(tmp_path.iterdir())


def test_a_bus_that_cannot_be_opened_is_a_plain_error(tmp_path: Path) -> None:
    found = command("run", str(PROJECT), "--bus", "slcan:/dev/no_such_port", "--state",
                    str(tmp_path / "state"))  # fmt: skip
    assert found.returncode == 3, found.stderr
    assert "/dev/no_such_port" in found.stderr and "Traceback" not in found.stderr


@pytest.mark.first_of(1)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_stop_before_the_bus_is_open_is_heard(number: signal.Signals, tmp_path: Path) -> None:
    """While kernels are being loaded, in the background of a script, where SIGINT is ignored."""
    process = subprocess.Popen(
        [*WITHOUT_INTERRUPT, "run", str(PROJECT), "--bus", "virtual:stop", "--test-bus",
         "--state", str(tmp_path)],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    while not (tmp_path / "lock").exists():
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(number)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 0 and "stopped" in said


def test_status_of_no_daemon(tmp_path: Path, called: Called) -> None:
    code, _, said = called("status", str(tmp_path))
    assert code == 3 and "rtid run" in said


def test_status_of_a_daemon_that_has_ended(tmp_path: Path, called: Called) -> None:
    write(tmp_path, full_status())
    code, shown, _ = called("status", str(tmp_path))
    assert code == 4 and "NOT RUNNING" in shown
    assert called("status", str(tmp_path), "--json")[1].strip() == read(tmp_path).to_json()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_the_page_ends_as_a_service_does(number: signal.Signals, tmp_path: Path) -> None:
    """With code 0, and without its worker, also where SIGINT is ignored."""
    pytest.importorskip("bokeh", reason="needs bokeh: pip install 'rtid[ui]'")
    (tmp_path / "none.csv").write_text("t_s,p_a\n0,1\n1,1\n")
    with subprocess.Popen(
        [*WITHOUT_INTERRUPT, "ui", str(PROJECT), "--no-open",
         str(tmp_path / "none.csv"), "--port", "0"],
        stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            assert "http://127.0.0.1" in process.stdout.readline()
            workers = list(children(process.pid))
            process.send_signal(number)
            assert process.wait(30.0) == 0
        finally:
            process.kill()  # `with` waits for it, also where the test has failed
    end_s = time.monotonic() + 5.0  # multiprocessing's tracker hears of it a moment later
    while left := [pid for pid in workers if command_of(pid)]:
        assert time.monotonic() < end_s, left
        time.sleep(0.05)
    assert workers
