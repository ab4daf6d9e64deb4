"""Frames from an slcan adapter on a serial port, read and parsed in bulk."""

from __future__ import annotations

import time

import numpy as np
import serial
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources.live import SourceError, now_us
from firmware_bridge.sources.port import PortSource
from firmware_bridge.sources.slcan_lines import ROLL_OVER_US, Decoder
from firmware_bridge.stamps import StampModel

BAUDRATE = 115_200  # USB adapters ignore it
BITRATES = {
    10_000: "S0", 20_000: "S1", 50_000: "S2", 100_000: "S3", 125_000: "S4",
    250_000: "S5", 500_000: "S6", 750_000: "S7", 800_000: "S7", 1_000_000: "S8",
}  # fmt: skip
SETTLE_S = 0.05  # between commands
FRAME_BITS, EXTENDED_BITS = 47, 20  # on the bus without data, stuff bits left out


class Spaced:
    """Times of frames without stamps: a piece's last frame came when the piece did.

    Those before it came earlier by at least their time on the bus; never before a frame already
    seen, and each at least 1 us after the one before.
    """

    def __init__(self, bitrate: int) -> None:
        self._us_per_bit = 1e6 / bitrate
        self._last_us = np.iinfo(np.int64).min // 2

    def push(self, frames: Frames, arrived_us: NDArray[np.int64]) -> Frames:
        """The frames with their times; arrived_us: int64 (n,), not falling."""
        bits = FRAME_BITS + 8.0 * frames.length + EXTENDED_BITS * (frames.can_id >= fr.EXTENDED)
        behind_us = np.rint(np.cumsum(bits) * self._us_per_bit).astype(np.int64)
        last_of_piece = np.searchsorted(arrived_us, arrived_us, "right") - 1
        due_us = arrived_us - (behind_us[last_of_piece] - behind_us)
        steps = np.arange(len(frames))
        later = np.maximum.accumulate(np.maximum(due_us - steps, self._last_us + 1)) + steps
        frames.t_us[:] = later
        if len(frames):
            self._last_us = int(later[-1])
        return frames


class Slcan(PortSource):
    """Frames from an slcan adapter, which is set to listen only unless told otherwise.

    bitrate: of the bus, None leaves it as the adapter has it; stamped: have the adapter stamp the
    frames (1 ms, mapped to this machine's clock by `stamps.StampModel`; without, a frame has the
    time of its arrival); settle_s: pause before the first command, 2 s for an adapter that restarts
    when it is opened.  Raises SourceError if it cannot be opened or knows no such bitrate.
    """

    def __init__(
        self,
        port: str,
        bitrate: int | None = None,
        *,
        baudrate: int = BAUDRATE,
        stamped: bool = False,
        listen_only: bool = True,
        settle_s: float = 0.0,
        reopen_s: float = 0.0,
    ) -> None:
        if bitrate is not None and bitrate not in BITRATES:
            known = ", ".join(str(rate) for rate in BITRATES)
            raise SourceError(f"slcan {port}: bitrate {bitrate}; choose one of {known}")
        speed = [BITRATES[bitrate]] if bitrate else []
        self._commands = ["C", *speed, "Z1" if stamped else "Z0", "L" if listen_only else "O"]
        self._settle_s = settle_s
        self._decoder = Decoder(stamped)
        self._model, self._spaced = StampModel(ROLL_OVER_US), Spaced(bitrate or max(BITRATES))
        super().__init__(port, baudrate, reopen_s)

    def _greet(self, line: serial.Serial) -> None:
        """Close the channel, forget what is left of it, set it up and open it."""
        time.sleep(self._settle_s)
        line.write(b"\r\r")  # end what an earlier user may have begun
        for command in self._commands:
            line.write(command.encode() + b"\r")
            line.flush()
            time.sleep(SETTLE_S)
            if command == "C":
                line.reset_input_buffer()

    def _decode(self, stream: bytes) -> tuple[Frames, NDArray[np.int64]]:
        return self._decoder.decode(stream)

    def _timed(self, frames: Frames, arrived_us: NDArray[np.int64]) -> Frames:
        if self._decoder.stamped:
            return self._model.push(frames, arrived_us)
        return self._spaced.push(frames, arrived_us)

    def _seam(self) -> tuple[int, bytes]:
        return now_us(), b"\r"

    def _close(self) -> None:
        try:
            self._line.write(b"C\r")
        finally:
            super()._close()
