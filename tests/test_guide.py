"""The guide's lines and sections, one after the other in one folder, as a reader follows them.

What its lines need is put beside them: a bus with a machine and a controller on it, older and other
traces; a record is learned once for all lines that need it.  `ADDED` tells what a line is given
here beyond the page, `LEFT` which lines other tests run.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from firmware_bridge.catalog import CONTROLLER_DBC
from rtid.cli import main
from rtid.cli.exits import Exit
from rtid.project import load
from rtid.study import kept
from tests.apply.neighbour import Neighbour, learned, offer
from tests.bridge.controller import Controller
from tests.faults import process
from tests.replays import shared_replays  # noqa: F401
from tests.test_docs import read, text_of

LEFT = {
    "rtid excite -p run.toml --after learned.npz --see valve_seat_leakage --out motion.csv":
        "9 s; tests/excite/test_machine.py designs after a record, and for an effect",
    "rtid compare run.blf -p run.toml --map sheet.csv --pictures pictures":
        "draws 19 pictures for 9 s; tests/test_compare_command.py does",
    "rtid report run.blf -p run.toml -o run.html":
        "draws for 6 s; tests/test_report.py and tests/browser/test_report_page.py do",
    "rtid quick jib.csv --save jib.toml": "tests/test_rate.py records a jib",
    "rtid quick jib.csv --role u=u_jib_pct --role x=x_jib_mm": "the same",
}  # fmt: skip
ADDED = {  # by the command: options for the test's bus, and less of what only takes time
    "apply": "--bus udp_multicast:{group} --test-bus --yes",
    "excite": "--duration 10 --no-compare",
    "fleet": "--workers 1",
    "run": "--bus udp_multicast:{group} --test-bus",
    "ui": "--port 0",
}
ENDS = {  # where that is not success alone: an alarm may be on
    "status": (Exit.OK, Exit.NEGATIVE)
}
# Two applies within seconds are no daily practice, and the maps that are offered here are made up.
BELOW = {"publish": "least_interval_s = 0\nmax_change_percent = 1000\nerror_percent = 1\n"}


@contextlib.contextmanager
def no_loop() -> Iterator[None]:
    """As in a terminal: a browser that other tests have opened leaves its loop to this thread.

    The page needs the main thread, whose signals end it, so that no other thread can call a line.
    """
    before = asyncio._get_running_loop()
    asyncio._set_running_loop(None)
    try:
        yield
    finally:
        asyncio._set_running_loop(before)


class Reader:
    """Somebody who follows the guide in the folder where he is."""

    def __init__(self, said: pytest.CaptureFixture[str]) -> None:
        self._said, self.group = said, process.a_group()
        self.told: dict[str, str] = {}
        self.beside = contextlib.ExitStack()
        self.before = {"quick": self.dbc, "apply": self.offers, "fleet": self.traces}

    def block(self, mark: str, text: str) -> None:
        """Enter a section into the project file, or call the lines."""
        if mark == "toml":
            name = text.partition("]")[0].removeprefix("[")
            with Path("run.toml").open("a") as file:
                file.write(f"\n{text}{BELOW.get(name, '')}")
            load("run.toml")
            return
        with self.beside:  # what runs beside the lines ends with them
            for line in text.splitlines():
                read(line)
                if line not in LEFT:
                    self.line(line)

    def line(self, line: str) -> None:
        """Call one line; it must end as it should."""
        _, name, *words = shlex.split(line)
        if prepare := self.before.pop(name, None):
            prepare()
        if name == "export" and "last_year.blf" in words:
            self.record("last_year", 4)
        words = [name, *words, *ADDED.get(name, "").format(group=self.group).split()]
        if name == "run":
            self.board(words)
            return
        code = self.call(words)
        assert code in ENDS.get(name, (Exit.OK,)), line
        self.told[" ".join(words[:2])] = self._said.readouterr().out

    def call(self, words: list[str]) -> int:
        with pytest.raises(SystemExit) as end, no_loop():
            main.run(words)
        return int(end.value.code or 0)

    def board(self, words: list[str]) -> None:
        """The daemon, in a process of its own, with a machine on its bus."""
        command = [sys.executable, "-m", "rtid", *words]
        running = subprocess.Popen(command, text=True, stdout=subprocess.PIPE)
        self.beside.callback(running.wait, process.LIMIT_S)
        self.beside.callback(running.terminate)
        at = process.Daemon(running, Path("run.state").resolve(), self.group, time.monotonic())
        at.wait(lambda status: status.bus.state == "open")
        self.beside.enter_context(process.sender(self.group, 5.0, trace=Path("run.blf").resolve()))
        at.wait(lambda status: status.estimate.samples > 1000)

    def dbc(self) -> None:
        """The catalog of the simulated machine."""
        shutil.copy(CONTROLLER_DBC, "machine.dbc")

    def offers(self) -> None:
        """A controller with the map of yesterday, and what the daemon offers in its place."""
        it = Neighbour(self.group, Controller(), lambda data, _: [data], "udp_multicast")
        self.beside.callback(it.stop)
        project, folder = load("run.toml"), Path("run.state")
        offer(folder, project, learned(project))
        self.line("rtid apply run.toml")
        offer(folder, project, learned(project, 0, 1.1), against=1)

    def traces(self) -> None:
        """A day of three machines."""
        for k in (1, 2, 3):
            Path(f"traces/m{k}").mkdir(parents=True)
            self.record(f"traces/m{k}/day1", k)

    def record(self, name: str, seed: int) -> None:
        """Another trace of the machine, without a project file."""
        made = f"rtid simulate {name}.blf --plant 3 --motion rich_record"
        self.line(f"{made} --duration 10 --seed {seed}")
        Path(f"{name}.toml").unlink()


@pytest.mark.long
def test_the_guide_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(kept.PLACE, str(tmp_path / "kept"))  # a reader's commands learn once
    monkeypatch.setattr(kept, "_secret", lambda: b"the reader's")
    monkeypatch.setattr(typer, "launch", lambda url: signal.raise_signal(signal.SIGTERM))
    blocks = re.findall(r"^```(sh|sh beside|toml)\n(.*?)^```", text_of("guide.md"), re.M | re.S)
    assert set(LEFT) <= {line for _, text in blocks for line in text.splitlines()}
    reader = Reader(capsys)
    for mark, text in blocks:
        reader.block(mark, text)
    assert "Internal leakage, laminar at a-b" in reader.told["diagnose run.blf"]
    assert "after" in reader.told["add run.blf"]
    assert "version 2" in reader.told["apply run.toml"]
    whole = load("run.toml").sections
    assert whole.prior is not None and whole.excite is not None and whole.publish.can_id == 0x700
