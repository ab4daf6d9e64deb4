from __future__ import annotations

import ast
import os
from pathlib import Path

import can
import pytest

from firmware_bridge import frames as fr
from firmware_bridge import playback
from firmware_bridge.playback import AS_FAST_AS_POSSIBLE, SendError, SerialSink, send
from firmware_bridge.sources.serial_port import Decoder
from tests.bridge.machine import cycles, equal
from tests.bridge.wire import Pty

BRIDGE = Path(playback.__file__).parent
SENDER = "playback.py"  # the only module that may send frames or write to a line
CONFIGURES = "slcan.py"  # writes its adapter's set-up: C, Sn, Z, L or O


def test_what_is_sent_is_what_a_serial_source_receives(line: Pty) -> None:
    frames = cycles(30)
    with SerialSink(line.name).armed() as sink:
        assert send(sink, fr.to_messages(frames), AS_FAST_AS_POSSIBLE) == len(frames)
    decoder, got = Decoder(), fr.empty(0)
    while len(got) < len(frames):
        got = fr.concatenate([got, decoder.push(os.read(line.master, 4096))])
    assert equal(got, frames)


def test_nothing_is_sent_unless_armed(line: Pty) -> None:
    sink, messages = SerialSink(line.name), list(fr.to_messages(cycles(1)))
    with pytest.raises(SendError, match="not armed"):
        send(sink, messages)
    with sink.armed():
        pass
    with pytest.raises(SendError, match="not armed"):
        sink.send(messages[0])
    os.set_blocking(line.master, False)
    with pytest.raises(BlockingIOError):
        os.read(line.master, 1)


def test_a_line_that_takes_nothing_is_an_error(line: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(playback, "SEND_TIMEOUT_S", 0.05)
    with pytest.raises(SendError, match=r"after \d+ frames"), SerialSink(line.name).armed() as sink:
        send(sink, fr.to_messages(cycles(3000)), AS_FAST_AS_POSSIBLE)


def test_other_frames_and_missing_ports_are_plain_errors(line: Pty) -> None:
    with SerialSink(line.name).armed() as sink, pytest.raises(SendError, match="remote_frame"):
        sink.send(can.Message(is_remote_frame=True))
    with pytest.raises(SendError, match="cannot open"), SerialSink("/dev/no_such_port").armed():
        pass
    with pytest.raises(SendError, match="baud rate"), SerialSink("/dev/x@y").armed():
        pass


def calls(path: Path) -> set[str]:
    """Names of all methods that a module calls."""
    nodes = ast.walk(ast.parse(path.read_text()))
    return {
        n.func.attr for n in nodes if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)
    }


def test_sending_lives_in_one_module() -> None:
    others = [path for path in sorted(BRIDGE.rglob("*.py")) if path.name != SENDER]
    for path in others:
        assert not calls(path) & {"send", "send_periodic", "sendall", "sendto"}, path
    on_lines = [path for path in others if "import serial" in path.read_text()]
    assert len(on_lines) >= 3
    for path in on_lines:
        assert not calls(path) & {"write", "writelines"} or path.name == CONFIGURES, path
