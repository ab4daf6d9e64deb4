"""The one place of the bridge that sends: recorded frames at their pace, and maps on order.

A bus or line is opened for sending only while its sink is armed.
Open a virtual bus with `preserve_timestamps=True`: only then does the receiver see the recorded
stamps; udp_multicast always stamps at reception.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, Self

import can
import serial

from firmware_bridge import frames as fr
from firmware_bridge.sources import serial_port
from firmware_bridge.sources.live import SourceError
from firmware_bridge.sources.port import split_baudrate
from firmware_bridge.sources.sockets import hear_one_group

AS_FAST_AS_POSSIBLE = float("inf")
SEND_TIMEOUT_S = 5.0  # a full queue of a virtual bus would block the sender for ever


class SendError(RuntimeError):
    """The bus cannot be opened or does not take the frames; `exit_code` 2 for a wrong argument."""

    def __init__(self, message: str, exit_code: int = 3) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Sink(Protocol):
    """What frames can be sent to: a python-can bus, an armed `BusSink` or `SerialSink`."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame; can.CanError if it is not taken within timeout seconds."""


class Exchange(Sink, Protocol):
    """A sink that also hears."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame; None where none came within timeout seconds."""


class SerialSink:
    """A serial line to send frames to, packed as `sources.serial_port` unpacks them.

    The port is opened only while it is armed, and refuses every frame before and after:

        with SerialSink("/dev/serial/by-id/...").armed() as sink:
            send(sink, messages)
    """

    def __init__(self, port: str, baudrate: int = serial_port.BAUDRATE) -> None:
        self._port, self._baudrate = port, baudrate
        self._line: serial.Serial | None = None
        self._decoder = serial_port.Decoder()
        self._heard: deque[can.Message] = deque()

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

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame on the line; None where none came within timeout seconds."""
        if self._line is None:
            raise SendError(f"serial port {self._port} is not armed: use `with sink.armed():`")
        end_s = time.monotonic() + (timeout or 0.0)
        try:
            while not self._heard:
                self._line.timeout = max(0.0, min(end_s - time.monotonic(), timeout or 0.0))
                piece = self._line.read(max(1, self._line.in_waiting))
                self._heard.extend(fr.to_messages(self._decoder.push(piece)))
                if not self._heard and time.monotonic() >= end_s:
                    return None
        except (serial.SerialException, OSError) as error:
            raise can.CanOperationError(f"serial port {self._port}: {error}") from error
        return self._heard.popleft()


class BusSink:
    """A CAN bus to send frames to, open only while it is armed; hears only `can_ids`."""

    def __init__(
        self,
        interface: str,
        channel: str | None,
        can_ids: Iterable[int] = (),
        bitrate: int | None = None,
    ) -> None:
        self._interface, self._channel = interface, channel
        self._options = {} if bitrate is None else {"bitrate": bitrate}
        self._filters = [
            {"can_id": i & 0x1FFF_FFFF, "can_mask": 0x1FFF_FFFF, "extended": bool(i & fr.EXTENDED)}
            for i in can_ids
        ]
        self._bus: can.BusABC | None = None

    @contextmanager
    def armed(self) -> Iterator[Self]:
        """Open the bus for sending until the block ends; SendError if it cannot be opened."""
        options: dict[str, Any] = {"can_filters": self._filters, **self._options}
        try:
            self._bus = can.Bus(self._channel, interface=self._interface, **options)
        except (can.CanError, OSError, ValueError) as error:
            raise SendError(f"cannot open {self._interface} {self._channel}: {error}", 2) from error
        hear_one_group(self._bus)
        try:
            yield self
        finally:
            self._bus.shutdown()
            self._bus = None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame; SendError unless armed, can.CanError if the bus does not take it."""
        self._open.send(msg, timeout=timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame; None where none came within timeout seconds."""
        return self._open.recv(timeout)

    @property
    def _open(self) -> can.BusABC:
        if self._bus is None:
            raise SendError(
                f"{self._interface} {self._channel} is not armed: use `with sink.armed():`"
            )
        return self._bus


class ArmedLink:
    """Frames of eight bytes to a controller through an armed sink, and its answers.

    can_id, reply_id: bit 31 set for 29 bit identifiers; frames_per_s: no more than so many.
    """

    def __init__(self, sink: Exchange, can_id: int, reply_id: int, frames_per_s: float) -> None:
        self._sink, self._can_id, self._reply_id = sink, can_id, reply_id
        self._pause_s, self._next_s = 1.0 / frames_per_s, 0.0
        self.told = 0

    def tell(self, data: bytes) -> None:
        """Send one frame, not before its turn; SendError if the bus does not take it."""
        wait_s = self._next_s - time.monotonic()
        if wait_s > 0:
            time.sleep(wait_s)
        self._next_s = max(self._next_s, time.monotonic() - 0.01) + self._pause_s
        message = can.Message(
            arbitration_id=self._can_id & 0x1FFF_FFFF,
            is_extended_id=bool(self._can_id & fr.EXTENDED),
            data=data,
        )
        try:
            self._sink.send(message, timeout=SEND_TIMEOUT_S)
        except can.CanError as error:
            raise SendError(f"after {self.told} frames: {error}; is the bus up?") from error
        self.told += 1

    def hear(self, timeout_s: float) -> bytes | None:
        """The next answer; None after timeout_s."""
        end_s = time.monotonic() + timeout_s
        while True:
            message = self._sink.recv(max(0.0, end_s - time.monotonic()))
            if message is not None and _id_of(message) == self._reply_id:
                return bytes(message.data)
            if time.monotonic() >= end_s:
                return None


def _id_of(message: can.Message) -> int:
    return message.arbitration_id | (fr.EXTENDED if message.is_extended_id else 0)


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
