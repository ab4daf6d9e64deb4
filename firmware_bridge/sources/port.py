"""What sources on a serial port share: pieces of bytes with their time of arrival."""

from __future__ import annotations

import contextlib
from abc import abstractmethod

import numpy as np
import serial
from numpy.typing import NDArray

from firmware_bridge.frames import Frames
from firmware_bridge.sources.live import POLL_S, LiveSource, SourceError, now_us

QUEUE_PIECES = 1 << 14  # more than 5 s of one piece per frame on a full line
Piece = tuple[int, bytes]  # microseconds, bytes


def split_baudrate(port: str, baudrate: int) -> tuple[str, int]:
    """Port and baud rate of "/dev/ttyACM0@2000000"; `baudrate` if none is given."""
    name, at, digits = port.rpartition("@")
    if not at:
        return port, baudrate
    if not digits.isdigit() or int(digits) == 0:
        raise SourceError(
            f"port {port}: after @ the baud rate is wanted, as in /dev/ttyACM0@115200"
        )
    return name, int(digits)


class PortSource(LiveSource[Piece]):
    """Frames from the bytes of a serial port (or a pty), given as "name" or "name@baudrate".

    Name adapters by /dev/serial/by-id/...: then an adapter that was pulled out is found again
    under any number.  Raises SourceError if the port cannot be opened.
    """

    def __init__(self, port: str, baudrate: int, reopen_s: float) -> None:
        super().__init__(QUEUE_PIECES, reopen_s)
        self._port, self._baudrate = split_baudrate(port, baudrate)
        self._open()

    @abstractmethod
    def _greet(self, line: serial.Serial) -> None:
        """Say to a newly opened line what it needs to hear."""

    @abstractmethod
    def _decode(self, stream: bytes) -> tuple[Frames, NDArray[np.int64]]:
        """Frames that became complete, and behind which byte of `stream` each one did."""

    @abstractmethod
    def _timed(self, frames: Frames, arrived_us: NDArray[np.int64]) -> Frames:
        """The frames with their final time stamps."""

    def _open(self) -> None:
        try:
            self._line = serial.Serial(self._port, self._baudrate, timeout=POLL_S)
        except (serial.SerialException, ValueError, OSError) as error:
            raise SourceError(f"cannot open serial port {self._port}: {error}") from error
        try:
            self._greet(self._line)
        except (serial.SerialException, OSError) as error:
            self._line.close()
            raise SourceError(f"serial port {self._port} does not take bytes: {error}") from error

    def _receive(self) -> Piece | None:
        piece: bytes = self._line.read(1)  # waits; then everything that is there
        if not piece:
            return None
        piece += self._line.read(self._line.in_waiting)
        return now_us(), piece

    def _convert(self, items: list[Piece]) -> Frames:
        frames, ends = self._decode(b"".join(piece for _, piece in items))
        arrived_us = np.array([arrival for arrival, _ in items], np.int64)
        borders = np.cumsum([len(piece) for _, piece in items])
        return self._timed(frames, arrived_us[np.searchsorted(borders, ends)])

    def _close(self) -> None:
        with contextlib.suppress(serial.SerialException, OSError):
            self._line.cancel_read()
        self._line.close()
