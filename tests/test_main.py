"""The command line as a whole: what it loads, how it ends, and the guard of the tests' bus."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import can
import pytest

import rtid
from firmware_bridge.catalog import CatalogError
from rtid.cli import main
from rtid.cli.exits import Exit
from rtid.errors import RtidError
from tests.command import ends

ROOT = Path(__file__).parents[1]


def test_version_and_help_load_neither_numba_nor_a_bus() -> None:
    code = (
        "import sys\nfrom rtid.cli.main import main\n"
        "try: main()\n"
        "finally: print('loaded:', sorted({'numba', 'can', 'numpy', 'scipy'} & set(sys.modules)))"
    )
    for argument in ("--help", "--version"):
        command = [sys.executable, "-c", code, argument]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
        assert done.stdout.endswith("loaded: []\n")


def test_a_command_that_reads_frames_does_not_load_what_reads_mf4(tmp_path: Path) -> None:
    """python-can loads asammdf, and that pandas, where it finds them: at each start."""
    log = tmp_path / "t.log"
    log.write_text("(1.5) can0 120#0011\n")
    code = (
        "import sys\nfrom rtid.cli.main import main\n"
        "try: main()\n"
        "finally: print('loaded:', sorted({'can', 'asammdf.mdf', 'pandas'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", code, "check", "--bus-only", str(log), "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.endswith("loaded: ['can']\n")


def test_the_page_of_a_daemon_loads_neither_numba_nor_a_bus() -> None:
    """It stands on a gateway beside the loop; where a record is opened the worker learns it."""
    code = "import rtid.ui.server, sys; print({'can', 'numba', 'scipy'} & set(sys.modules) or '')"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert ends("--version") == Exit.OK
    assert capsys.readouterr().out == f"rtid {rtid.__version__}\n"


@pytest.mark.parametrize(("given", "used"), [(None, "1"), ("2", "2")])
def test_linear_algebra_stays_on_one_thread_unless_asked(
    given: str | None, used: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    if given:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", given)
    monkeypatch.setattr(sys, "argv", ["rtid", "--version"])
    with pytest.raises(SystemExit):
        main.main()
    assert os.environ["OPENBLAS_NUM_THREADS"] == used


@pytest.mark.parametrize("arguments", [["no-such-command"], ["--no-such-option"]])
def test_wrong_usage(arguments: list[str]) -> None:
    assert ends(*arguments) == Exit.USAGE


ORDERS = {
    "replay run.blf -p m.toml": "replay run.blf -p m.toml",
    "replay m.toml -p run.blf": "replay run.blf -p m.toml",
    "diagnose m.toml run.blf --json": "diagnose run.blf --json -p m.toml",
    "add --project run.blf leak m.toml": "add --project m.toml leak run.blf",
    "compare run.blf -p a.toml --against b.toml": "compare run.blf -p a.toml --against b.toml",
    "compare run.blf --against b.toml": "compare run.blf --against b.toml",
    "run m.toml": "run m.toml",
    "refit plant.toml t.csv": "refit plant.toml t.csv",
    "": "",
}


@pytest.mark.parametrize("words", ORDERS)
def test_a_project_in_a_trace_s_place_is_recognised(words: str) -> None:
    assert " ".join(main.in_order(words.split())) == ORDERS[words]


@pytest.mark.parametrize("words", ["check run.blf", "check a.toml b.toml", "ui a.toml b.toml"])
def test_what_is_no_trace_and_project_is_told_so(
    words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ends(*words.split()) == Exit.USAGE
    assert "-p PROJECT" in capsys.readouterr().err


def test_every_listed_command_has_its_function() -> None:
    for name in main.COMMANDS:
        if find_spec(f"rtid.cli.{name}"):
            assert main.build([name, "--help"]).registered_commands


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (RtidError("no wanted frame", "name the channel"), Exit.INPUT, "-> name the channel"),
        (RtidError("key beta: unknown", exit_code=Exit.USAGE), Exit.USAGE, "key beta: unknown"),
        (CatalogError("the DBC has no message"), Exit.INPUT, "rtid: the DBC has no message"),
        (FileNotFoundError(2, "No such file", "trace.blf"), Exit.INPUT, "trace.blf: No such file"),
        (KeyboardInterrupt(), Exit.INTERRUPTED, ""),
    ],
)
def test_an_expected_error_is_one_plain_message(
    error: BaseException,
    code: int,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(main, "find_spec", lambda name: name.endswith(".demo"))
    monkeypatch.setattr(main, "_function", lambda name: fail)
    assert ends("demo") == code
    printed = capsys.readouterr().err
    assert message in printed
    assert "Traceback" not in printed


def test_an_unexpected_error_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(main, "find_spec", lambda name: name.endswith(".demo"))
    monkeypatch.setattr(main, "_function", lambda name: fail)
    with pytest.raises(ZeroDivisionError):
        main.run(["demo"])


class RealBus(can.BusABC):
    """Stands for a bus with hardware behind it."""

    def __init__(self, **kwargs: Any) -> None:
        self.reached_the_wire = 0
        super().__init__(channel="can0", **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.reached_the_wire += 1


def test_no_test_can_send_on_a_real_bus(no_real_bus: list[str]) -> None:
    with RealBus() as bus, pytest.raises(AssertionError, match="real bus"):
        bus.send(can.Message(arbitration_id=1))
    assert bus.reached_the_wire == 0
    assert len(no_real_bus) == 1
    no_real_bus.clear()


FREED = """
import numpy as np
from rtid.cli.main import return_large_memory

def anonymous_mb():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("RssAnon")) / 1024

return_large_memory()
del_first = np.ones(3_000_000)
del del_first  # glibc would keep the next one of this size
large, stays = np.ones(3_000_000), np.ones(12_000)
before = anonymous_mb()
del large
print(before - anonymous_mb())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="of the C library of Linux")
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has no mallopt")
def test_freed_memory_goes_back_to_the_system() -> None:
    done = subprocess.run([sys.executable, "-c", FREED], capture_output=True, text=True, check=True)
    assert float(done.stdout) > 20.0


@pytest.mark.parametrize("size", ["", "much", "1048576"])
def test_the_user_s_own_setting_of_the_c_library_stays(
    monkeypatch: pytest.MonkeyPatch, size: str
) -> None:
    """Whatever it says: glibc passes over what is no number."""
    environment = {"MALLOC_TRIM_THRESHOLD_": size}
    monkeypatch.setattr(os, "environ", environment)
    main.return_large_memory()
    assert environment["MALLOC_TRIM_THRESHOLD_"] == size
    assert environment["MALLOC_MMAP_THRESHOLD_"].isdecimal()
