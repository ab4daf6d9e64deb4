"""What live sources share: a receive thread that only queues, and opens again what failed.

So a slow reader loses nothing while the queue lasts; an error in the thread reaches the reader.
"""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator
from types import TracebackType
from typing import Generic, Self, TypeVar

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames

Item = TypeVar("Item")
QUEUE_ITEMS = 100_000  # a full 1 Mbit/s bus for more than 10 s
POLL_S = 0.1  # how long the thread waits before it looks whether it shall stop
BACK_OFF_S = (0.1, 2.0)  # first and longest pause before another try to open

_EPOCH_US = time.time_ns() // 1000 - time.monotonic_ns() // 1000


class SourceError(RuntimeError):
    """The bus or line failed while receiving; the cause is chained."""


def now_us() -> int:
    """Stamp of something that arrives now: the wall clock at import, never stepped since."""
    return time.monotonic_ns() // 1000 + _EPOCH_US


class Source(ABC):
    """An iterator of small batches of frames; a context manager that starts and stops it."""

    @abstractmethod
    def start(self) -> Self:
        """Begin to receive; harmless when called again."""

    @abstractmethod
    def read(self, timeout_s: float = POLL_S) -> Frames:
        """All frames received so far; waits for the first, at most timeout_s (then empty).

        Raises SourceError once everything received before the failure has been read.
        """

    @abstractmethod
    def stop(self) -> None:
        """End receiving and release the bus; harmless when called again or from any state."""

    @property
    @abstractmethod
    def is_over(self) -> bool:
        """Whether it was stopped and everything has been read."""

    @property
    @abstractmethod
    def is_down(self) -> bool:
        """Whether it has failed and is being opened again."""

    @property
    @abstractmethod
    def queued(self) -> int:
        """Items that wait to be read."""

    def __iter__(self) -> Iterator[Frames]:
        """Batches until `stop` is called and the queue is empty; never an empty batch."""
        while not self.is_over:
            frames = self.read()
            if len(frames) or frames.refused:
                yield frames

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()


class LiveSource(Source, Generic[Item]):
    """A source with a receive thread; nothing here ever sends a frame.

    When the queue is full the oldest item is dropped and counted as "overrun".  A failed bus or
    line is opened again for at most `reopen_s` (0: not at all), each success is counted as
    "reopened"; only then does the failure reach the reader.
    """

    def __init__(self, queue_items: int = QUEUE_ITEMS, reopen_s: float = 0.0) -> None:
        self._queue: deque[Item] = deque()
        self._queue_items = queue_items
        self._reopen_s = reopen_s
        self._counts: dict[str, int] = {}
        self._arrived = threading.Condition()
        self._stopped = threading.Event()
        self._error: Exception | None = None
        self._down = False
        self._thread = threading.Thread(target=self._run, name="rtid-receive", daemon=True)

    @abstractmethod
    def _open(self) -> None:
        """Open the bus or line; SourceError if that fails."""

    @abstractmethod
    def _receive(self) -> Item | None:
        """One item, or None after POLL_S without any."""

    @abstractmethod
    def _convert(self, items: list[Item]) -> Frames:
        """Frames of these items."""

    @abstractmethod
    def _close(self) -> None:
        """Release the bus or line."""

    def _seam(self) -> Item | None:
        """What to queue between the items from before and after opening again."""
        return None

    def start(self) -> Self:
        """Begin to receive; harmless when called again."""
        if self._thread.ident is None:
            self._thread.start()
        return self

    def share(self, arrived: threading.Condition) -> None:
        """Tell of arrivals through this condition, which others may share; before `start`."""
        self._arrived = arrived

    def read(self, timeout_s: float = POLL_S) -> Frames:
        """See `Source.read`."""
        with self._arrived:
            self._arrived.wait_for(lambda: self.is_due, timeout_s)
            items, counts = list(self._queue), self._counts
            self._queue.clear()
            self._counts = {}
        if not items and self._error is not None:
            raise SourceError(f"receiving failed: {self._error}") from self._error
        frames = self._convert(items)
        fr.add_counts(frames.refused, counts)
        return frames

    def stop(self) -> None:
        """End the thread and release the bus; harmless when called again or from any state."""
        self._stopped.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(10 * POLL_S)
        with contextlib.suppress(Exception):  # an unplugged adapter cannot be closed properly
            self._close()

    @property
    def is_over(self) -> bool:
        """See `Source.is_over`."""
        return self._stopped.is_set() and not self._queue

    @property
    def is_down(self) -> bool:
        """See `Source.is_down`."""
        return self._down

    @property
    def queued(self) -> int:
        """See `Source.queued`."""
        return len(self._queue)

    @property
    def is_due(self) -> bool:
        """Whether `read` would return at once."""
        return bool(self._queue) or self._error is not None or self._stopped.is_set()

    def _run(self) -> None:
        try:
            while not self._stopped.is_set():
                item = self._next()
                if item is not None:
                    self._put(item)
        except Exception as error:  # anything that drivers raise must reach the reader
            if not self._stopped.is_set():
                self._error = error
        with self._arrived:
            self._arrived.notify_all()

    def _next(self) -> Item | None:
        try:
            return self._receive()
        except Exception:
            self._down = True
            if not self._reopened():
                raise
            self._down = False
            return self._seam()

    def _reopened(self) -> bool:
        """Close and open again, with growing pauses; whether that worked in time."""
        end_s, pause_s = time.monotonic() + self._reopen_s, BACK_OFF_S[0]
        if self._reopen_s > 0:
            with contextlib.suppress(Exception):
                self._close()
        while time.monotonic() < end_s and not self._stopped.wait(pause_s):
            with contextlib.suppress(SourceError):
                self._open()
                with self._arrived:
                    fr.add_counts(self._counts, {"reopened": 1})
                return True
            pause_s = min(2 * pause_s, BACK_OFF_S[1])
        return False

    def _put(self, item: Item) -> None:
        with self._arrived:
            if len(self._queue) >= self._queue_items:
                self._queue.popleft()
                fr.add_counts(self._counts, {"overrun": 1})
            self._queue.append(item)
            self._arrived.notify_all()
