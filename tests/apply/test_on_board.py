"""The daemon's part: it sends nothing unless it is armed, and hands answers on."""

from __future__ import annotations

import fcntl
import os
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

import rtid
from firmware_bridge import frames as fr
from firmware_bridge import protocol
from firmware_bridge.protocol import Op
from firmware_bridge.sources import serial_port
from firmware_bridge.sources.live_bus import open_live
from rtid.apply import offer as offered
from rtid.apply import reach
from rtid.apply.answers import Answers, answers_of
from rtid.apply.session import apply_map
from rtid.apply.wish import Wish
from rtid.daemon.notices import frames_of, telling
from rtid.daemon.status import Alarm, ChamberStatus, EdgeHealth, EstimateStatus, Verdict
from rtid.errors import RtidError
from rtid.estimator.flowmap import FlowMap
from rtid.project import load
from tests.apply.neighbour import (
    REPLY_ID,
    STATUS_ID,
    learned,
    loaded,
    neighbour,
    offer,
    project_file,
)
from tests.bridge.controller import Controller, notice
from tests.bridge.wire import Pty
from tests.daemon.test_parts import full_status


def test_notices_as_the_firmware_reads_them() -> None:
    estimate = EstimateStatus(
        "held",
        stale=False,
        chambers=(
            ChamberStatus("a", 8.123e8, 2.6e6),
            ChamberStatus("b", None),
            ChamberStatus("c", float("inf")),
        ),
        edges=(
            EdgeHealth("pa", {"valid": 6, "learning": 2}, {}, 0.5),
            EdgeHealth("pb", {"valid": 1, "stale": 1}, {}, 1.0),
            EdgeHealth("ab"),
        ),
    )
    on, over = Alarm("x", "", 1.0), Alarm("y", "", 1.0, 2.0)
    status = replace(
        full_status(), estimate=estimate, alarms=(on, over), verdict=Verdict(1.0, "missing", "")
    )
    told, a, c = (notice(data) for data in frames_of(status, True, 259))
    assert told[0] == Op.STATUS
    assert told[1][:7] == [2, 2, 1, 75, 70, 2, 3]
    assert a[0] == Op.BETA and a[1][7:] == [0.0, pytest.approx(8.123e8), pytest.approx(2.6e6)]
    assert c[1][7:] == [2.0, 0.0, 0.0]
    assert notice(b"\x61" + bytes(7))[0] == 0 and notice(protocol.open_frame(5))[0] == 0


@pytest.mark.parametrize("is_armed", [False, True])
def test_status_is_told_only_if_the_project_says_so(tmp_path: Path, is_armed: bool) -> None:
    project = loaded(tmp_path, status=is_armed, status_id=STATUS_ID)
    with neighbour() as there:
        with telling(project, ("virtual", there.channel), tmp_path, full_status):
            time.sleep(1.5)
        heard = [message.arbitration_id for message in there.all]
    assert (len(heard) > 0) is is_armed
    assert set(heard) <= {STATUS_ID}


def frames_with(can_ids: list[int]) -> fr.Frames:
    out = fr.empty(len(can_ids))
    out.can_id[:], out.length[:] = can_ids, 8
    out.data[:, 0] = np.arange(len(can_ids))
    return out


def test_answers_are_handed_on_to_whoever_waits(tmp_path: Path) -> None:
    from rtid.apply.answers import heard

    answers = Answers(tmp_path, REPLY_ID)
    answers.take(frames_with([REPLY_ID]))  # nobody waits
    with heard(tmp_path) as listening:
        answers.take(frames_with([0x120, REPLY_ID, 0x121, REPLY_ID]))
        listening.settimeout(1.0)
        assert [listening.recv(64)[0] for _ in range(2)] == [1, 3]
    assert not list(tmp_path.iterdir())
    answers.take(frames_with([REPLY_ID]))


def test_who_hands_answers_on(tmp_path: Path) -> None:
    project = loaded(tmp_path)
    assert answers_of(project, tmp_path, "socketcan") is None
    assert answers_of(project, tmp_path, "serial") is not None


@contextmanager
def on_a_line(controller: Controller) -> Iterator[Pty]:
    """A controller at the far end of a serial line."""
    line, stopped = Pty(), threading.Event()
    decoder = serial_port.Decoder()
    os.set_blocking(line.master, False)

    def serve() -> None:
        while not stopped.is_set():
            try:
                piece = os.read(line.master, 4096)
            except BlockingIOError:
                time.sleep(0.001)
                continue
            except OSError:
                return
            for message in fr.to_messages(decoder.push(piece)):
                controller.now_ms += 1
                for answer in controller.push(bytes(message.data)):
                    reply = can.Message(arbitration_id=REPLY_ID, is_extended_id=False, data=answer)
                    os.write(line.master, serial_port.encode(fr.from_messages([reply])))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield line
    finally:
        stopped.set()
        thread.join(2.0)
        line.unplug()


@pytest.fixture(scope="module")
def flow_map(tmp_path_factory: pytest.TempPathFactory) -> FlowMap:
    return learned(loaded(tmp_path_factory.mktemp("project")))


def test_over_a_serial_line(tmp_path: Path, flow_map: FlowMap) -> None:
    path, controller = project_file(tmp_path), Controller()
    offer(tmp_path / "state", load(path), flow_map)
    with on_a_line(controller) as line:
        wish = Wish(bus=f"serial:{line.name}", state=tmp_path / "state")
        _, row = apply_map(path, wish, lambda plan: True)
    assert row is not None and controller.held(0) == (1, row.crcs[0])


def test_over_a_serial_line_that_the_daemon_reads(tmp_path: Path, flow_map: FlowMap) -> None:
    path, folder, controller = project_file(tmp_path), tmp_path / "state", Controller()
    offer(folder, load(path), flow_map)
    with (
        on_a_line(controller) as line,
        (folder / reach.LOCK_FILE).open("w") as lock,
        open_live("serial", line.name) as source,
    ):
        fcntl.flock(lock, fcntl.LOCK_EX)  # as the daemon does
        answers, stopped = answers_of(load(path), folder, "serial"), threading.Event()
        assert answers is not None and reach.is_running(folder)

        def listen() -> None:
            while not stopped.is_set():
                answers.take(source.read(0.01))

        thread = threading.Thread(target=listen, daemon=True)
        thread.start()
        wish = Wish(bus=f"serial:{line.name}", state=folder)
        _, row = apply_map(path, wish, lambda plan: True)
        stopped.set()
        thread.join()
    assert row is not None and controller.held(4) == (1, row.crcs[4])
    assert not offered.exists(folder)


def test_an_adapter_that_the_daemon_only_listens_with(tmp_path: Path, flow_map: FlowMap) -> None:
    path, folder = project_file(tmp_path), tmp_path / "state"
    offer(folder, load(path), flow_map)
    with (folder / reach.LOCK_FILE).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        wish = Wish(bus="slcan:/dev/ttyACM7", state=folder)
        with pytest.raises(RtidError, match="listen only"):
            apply_map(path, wish, lambda plan: True)


RTID = Path(rtid.__file__).parent


def test_only_one_module_of_rtid_arms_a_bus() -> None:
    """Whoever could send is named here: `reach` for the controller, the rest for test buses."""
    arming, opening = set(), set()
    for path in RTID.rglob("*.py"):
        text, name = path.read_text("utf-8"), path.relative_to(RTID).as_posix()
        if re.search(r"\b(BusSink|SerialSink|ArmedLink)\b", text):
            arming.add(name)
        if re.search(r"\bcan\.(Bus|interface\.Bus|ThreadSafeBus)\(", text):
            opening.add(name)
    assert arming == {"apply/reach.py"}
    assert opening <= {"trace/learner.py", "sim/bus.py"}  # `virtual_bus` and `open_test_bus`
    users = {
        path.relative_to(RTID).as_posix()
        for path in RTID.rglob("*.py")
        if "reach.armed(" in path.read_text("utf-8")
    }
    assert users == {"apply/session.py", "daemon/notices.py"}
