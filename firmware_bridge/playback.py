"""Playing frames onto a bus or line at their recorded pace: the one place of the bridge that sends.

Open a virtual bus with `preserve_timestamps=True`: only then does the receiver see the recorded
stamps; udp_multicast always stamps at reception.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol, Self

import can
import serial

from firmware_bridge import frames as fr
from firmware_bridge.sources import serial_port
from firmware_bridge.sources.live import SourceError
from firmware_bridge.sources.port import split_baudrate

AS_FAST_AS_POSSIBLE = float("inf")
SEND_TIMEOUT_S = 5.0  # a full queue of a virtual bus would block the sender for ever


class SendError(RuntimeError):
    """The bus cannot be opened or does not take the frames; `exit_code` 2 for a wrong argument."""

    def __init__(self, message: str, exit_code: int = 3) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Sink(Protocol):
    """What frames can be sent to: a python-can bus, or an armed `SerialSink`."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame; can.CanError if it is not taken within timeout seconds."""


class SerialSink:
    """A serial line to send frames to, packed as `sources.serial_port` unpacks them.

    The port is opened only while it is armed, and refuses every frame before and after:

        with SerialSink("/dev/serial/by-id/...").armed() as sink:
            send(sink, messages)
    """

    def __init__(self, port: str, baudrate: int = serial_port.BAUDRATE) -> None:
        self._port, self._baudrate = port, baudrate
        self._line: serial.Serial | None = None

    @contextmanager
    def armed(self) -> Iterator[Self]:
        """Open the port for sending until the block ends; SendError if it cannot be opened."""
        try:
            name, baudrate = split_baudrate(self._port, self._baudrate)
            self._line = serial.Serial(name, baudrate)
        except (serial.SerialException, ValueError, OSError, SourceError) as error:
            raise SendError(f"cannot open serial port {self._port}: {error}", 2) from error
        try:
            yield self
            self._line.flush()
        finally:
            self._line.close()
            self._line = None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Write one frame; SendError unless armed, CanOperationError if the line does not take it.

        A frame that a serial line cannot carry (remote, error, FD) is a SendError as well.
        """
        if self._line is None:
            raise SendError(f"serial port {self._port} is not armed: use `with sink.armed():`")
        frames = fr.from_messages([msg])
        for kind in frames.refused:
            raise SendError(f"a serial line carries data frames only, not a {kind}")
        try:
            if self._line.write_timeout != timeout:
                self._line.write_timeout = timeout
            self._line.write(serial_port.encode(frames))
        except (serial.SerialException, OSError) as error:
            raise can.CanOperationError(f"serial port {self._port}: {error}") from error


def send(
    bus: Sink,
    messages: Iterable[can.Message],
    speed: float = 1.0,
    *,
    clock_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Send all messages at `speed` times their recorded pace (inf: at once); the number sent.

    Raises SendError for a speed that is not positive, or if the bus takes no more frames for 5 s.
    """
    if not speed > 0:
        raise SendError(f"speed {speed:g}: must be > 0, or inf for as fast as possible", 2)
    if speed != AS_FAST_AS_POSSIBLE:
        messages = _paced(messages, speed, clock_s, sleep)
    sent = 0
    for message in messages:
        try:
            bus.send(message, timeout=SEND_TIMEOUT_S)
        except can.CanError as error:
            raise SendError(f"after {sent} frames: {error}; is a receiver stalled?") from error
        sent += 1
    return sent


def _paced(
    messages: Iterable[can.Message],
    speed: float,
    clock_s: Callable[[], float],
    sleep: Callable[[float], None],
) -> Iterator[can.Message]:
    """Hold back each message until its time; late ones follow at once."""
    start_s, first_s = clock_s(), None
    for message in messages:
        first_s = message.timestamp if first_s is None else first_s
        wait_s = (message.timestamp - first_s) / speed - (clock_s() - start_s)
        if wait_s > 0:
            sleep(wait_s)
        yield message
