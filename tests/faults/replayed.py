"""A daemon that hears a trace again and again, faster: `python -m tests.faults.replayed`.

Arguments: PROJECT TRACE STATE SECONDS SPEED LOOPS.  The frames come from memory, so that none can
be lost on a machine that has other work; the next loop comes a second later.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources import open_log
from firmware_bridge.sources.live import LiveSource
from rtid.daemon import log
from rtid.daemon.daemon import Bus, Daemon, stopped_by_signals
from rtid.project import load
from tests.faults.sender import PAUSE_S

PIECE = 300  # frames


class Replayed(LiveSource[Frames]):
    """The frames of `loops` passes at `speed` times their pace."""

    def __init__(self, frames: Frames, seconds: float, speed: float, loops: int) -> None:
        super().__init__()
        self._pieces = _pieces(frames, seconds, loops)
        self._first_us, self._speed = int(frames.t_us[0]), speed
        self._waiting: Frames | None = next(self._pieces)
        self._start_s = time.monotonic()

    def _open(self) -> None:
        """Nothing to open."""

    def _receive(self) -> Frames | None:
        piece = self._waiting
        if piece is None:
            time.sleep(0.05)
            return None
        due_s = float(piece.t_us[-1] - self._first_us) * 1e-6 / self._speed
        time.sleep(max(0.0, self._start_s + due_s - time.monotonic()))
        self._waiting = next(self._pieces, None)
        return piece

    def _convert(self, items: list[Frames]) -> Frames:
        return fr.concatenate(items)

    def _close(self) -> None:
        """Nothing to close."""


def _pieces(frames: Frames, seconds: float, loops: int) -> Iterator[Frames]:
    for k in range(loops):
        for part in frames.chunks(PIECE):
            again = part[:]
            yield Frames(
                again.t_us + round(k * (seconds + PAUSE_S) * 1e6),
                again.channel, again.can_id, again.length, again.data,
            )  # fmt: skip


def main() -> None:
    """Run until stopped."""
    project, trace, state, seconds, speed, loops = sys.argv[1:]
    log.set_up()
    frames = open_log(Path(trace))

    def bus() -> Replayed:
        return Replayed(frames, float(seconds), float(speed), int(loops))

    daemon = Daemon(load(project), Bus("replayed", trace, bus), Path(state))
    with stopped_by_signals(daemon):
        print(daemon.run().to_json())


if __name__ == "__main__":
    main()
