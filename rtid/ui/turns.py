"""The pages take turns: what is long is done for one page at a time, beside the loop.

Twenty pages that all draw when a record is learned would otherwise do so in one go, and nobody
would be answered meanwhile.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

PAUSE_S = 0.01  # for everybody else
Do = Callable[[], None]
T = TypeVar("T")


class Turns:
    """Steps in their order; `later(seconds, do)` is the loop's."""

    def __init__(self, later: Callable[[float, Do], object]) -> None:
        self._later = later
        self._waiting: deque[Do] = deque()
        self._is_going = self._is_over = False
        self.is_working = False  # something is done beside the loop: the next step waits
        self._studio = ThreadPoolExecutor(1, "rtid-studio")
        self._studio.submit(int)  # its thread begins now

    def take(self, step: Do) -> None:
        """Do this when its turn comes; call from the loop's thread."""
        self._waiting.append(step)
        if not self._is_going:
            self._is_going = True
            self._later(0.0, self._next)

    async def apart(self, do: Do) -> None:
        """Do this in a thread of its own; the loop goes on meanwhile.  After `stop` nothing is."""
        if self._is_over:
            return
        self.is_working = True
        try:
            await asyncio.get_running_loop().run_in_executor(self._studio, do)
        finally:
            self.is_working = False

    async def packed(self, pack: Callable[[], T]) -> T:
        """The same for a message: behind what is drawn, and no step waits for it."""
        if self._is_over:
            return pack()
        return await asyncio.get_running_loop().run_in_executor(self._studio, pack)

    def stop(self) -> None:
        """End the thread."""
        self._is_over = True
        self._studio.shutdown(cancel_futures=True)

    def _next(self) -> None:
        try:
            if not self.is_working:
                self._waiting.popleft()()
        finally:
            self._is_going = bool(self._waiting)
            if self._is_going:
                self._later(PAUSE_S, self._next)
