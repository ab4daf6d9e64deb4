"""A daemon in a process of its own: it sends nothing, offers a map, and `rtid apply` sends it."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from pathlib import Path

import can
import pytest

from firmware_bridge.sources.sockets import hear_one_group
from rtid.apply import offer as offered
from rtid.cli.exits import Exit
from tests.apply.neighbour import CAN_ID, Neighbour
from tests.bridge.controller import Controller
from tests.faults import process

PUBLISH = """
[publish]
can_id = 0x700
reply_id = 0x701
status_id = 0x702
judge_s = 12
error_percent = 1
least_interval_s = 0
max_change_percent = 1000
"""


def rtid(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "rtid", *arguments],
        capture_output=True, text=True, check=False, timeout=process.HANGS_S,
    )  # fmt: skip


class Listener:
    """Everything on the group that is not the machine's own three messages."""

    def __init__(self, group: str) -> None:
        self._bus = can.Bus(group, interface="udp_multicast")
        hear_one_group(self._bus)
        self.heard: list[int] = []
        self._notifier = can.Notifier(self._bus, [self._take])

    def _take(self, message: can.Message) -> None:
        if message.arbitration_id not in (0x120, 0x121, 0x122):
            self.heard.append(message.arbitration_id)

    def stop(self) -> None:
        self._notifier.stop()
        self._bus.shutdown()


@pytest.mark.faults
def test_offer_apply_and_undo_beside_a_running_daemon(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        at = stack.enter_context(process.daemon(tmp_path, settings=f"publish_s = 3\n{PUBLISH}"))
        at.wait(lambda status: status.bus.state == "open")
        listener = Listener(at.group)
        stack.callback(listener.stop)
        sending = stack.enter_context(process.sender(at.group, 60.0, speed=3.0, loops=100))
        for _ in at.patiently():
            if offered.exists(at.folder):
                break
        sending.kill()  # so that no other offer follows what was on its way
        at.wait(lambda status: all(message.verdict == "silent" for message in status.messages))
        assert listener.heard == [], "a daemon that is not armed has sent something"

        it = Neighbour(at.group, Controller(), lambda data, _: [data], "udp_multicast")
        stack.callback(it.stop)
        call = ["apply", str(tmp_path / "machine.toml"), "--state", str(at.folder)]
        call += ["--bus", f"udp_multicast:{at.group}", "--test-bus", "--yes"]
        done = rtid(*call)
        assert done.returncode == Exit.OK, done.stderr
        assert "active: version 1" in done.stdout
        held = it.controller.held(0)
        assert held is not None and held[0] == 1
        assert CAN_ID in listener.heard
        assert rtid(*call).returncode == Exit.NEGATIVE, "an offer is for one apply"
        assert rtid(*call, "--undo").returncode == Exit.NEGATIVE, "there was none before"
        status = at.stop()
        assert status.estimate.version > 0
