"""Serial lines for the tests: a pty with somebody at its other end, and noise on the way."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import tty
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources.live import Source

KINDS = ("replaced", "inserted", "deleted")


class Pty:
    """A line to a controller or adapter: `name` is the port, `master` the other end."""

    def __init__(self) -> None:
        self.master, self._slave = os.openpty()
        for end in (self.master, self._slave):
            tty.setraw(end)
        self.name = os.ttyname(self._slave)
        self._sending = threading.Lock()  # an adapter's answer never stands within a frame's line

    def unplug(self) -> None:
        """Close both ends; harmless when called again."""
        for end in (self.master, self._slave):
            with contextlib.suppress(OSError):
                os.close(end)
        self.master = self._slave = -1

    def feed(self, stream: bytes) -> threading.Thread:
        """Write the bytes from a thread, as fast as they are taken."""

        def write() -> None:
            view = memoryview(stream)
            with contextlib.suppress(OSError), self._sending:  # unplugged meanwhile
                while view:
                    view = view[os.write(self.master, view[:2048]) :]

        thread = threading.Thread(target=write, daemon=True)
        thread.start()
        return thread

    def answer(self, reply: Callable[[bytes], bytes]) -> threading.Thread:
        """Answer every command that ends in CR from a thread, until the line is unplugged."""

        def run() -> None:
            pending = b""
            with contextlib.suppress(OSError):
                while True:
                    pending += os.read(self.master, 256)
                    *commands, pending = pending.split(b"\r")
                    for command in commands:
                        answer = reply(command)
                        with self._sending:
                            os.write(self.master, answer)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        return thread


def noisy(stream: bytes, n: int, seed: int, kind: str) -> tuple[bytes, NDArray[np.int64]]:
    """The stream with n random bad bytes, and where in the original they are."""
    rng = np.random.default_rng(seed)
    text = np.frombuffer(stream, np.uint8)
    places = np.sort(rng.choice(len(text), n, replace=False))
    wrong = rng.integers(0, 256, n, np.uint8)
    if kind == "deleted":
        return np.delete(text, places).tobytes(), places
    if kind == "inserted":
        return np.insert(text, places, wrong).tobytes(), places
    text = text.copy()
    text[places] ^= np.maximum(wrong, 1)
    return text.tobytes(), places


def contents(frames: Frames, stamps: bool = True) -> list[tuple[int, int, bytes]]:
    """What each frame says; without `stamps` its time does not count."""
    t_us = frames.t_us if stamps else np.zeros(len(frames), np.int64)
    data = (row[:n].tobytes() for row, n in zip(frames.data, frames.length, strict=True))
    return list(zip(t_us.tolist(), frames.can_id.tolist(), data, strict=True))


def read_until(source: Source, last: Frames, stamps: bool = True, quiet_s: float = 10.0) -> Frames:
    """Everything up to the frames `last`; fails if nothing comes for quiet_s."""
    wanted, heard_s = contents(last, stamps), time.monotonic()
    parts: list[Frames] = []
    tail: list[tuple[int, int, bytes]] = []
    while tail[-len(wanted) :] != wanted:
        assert time.monotonic() - heard_s < quiet_s, "wedged"
        parts.append(source.read(1.0))
        if len(parts[-1]):
            heard_s = time.monotonic()
            tail = (tail + contents(parts[-1][-len(wanted) :], stamps))[-len(wanted) :]
    return fr.concatenate(parts)
