"""What live sources share: a receive thread that only queues.

So a slow reader loses nothing while the queue lasts; an error in the thread reaches the reader.
"""

from __future__ import annotations

import contextlib
import threading
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


class SourceError(RuntimeError):
    """The bus or line failed while receiving; the cause is chained."""


class LiveSource(ABC, Generic[Item]):
    """An iterator of small batches of frames; a context manager that ends the thread.

    Nothing here ever sends.  When the queue is full the oldest item is dropped and counted as
    "overrun".
    """

    def __init__(self, queue_items: int = QUEUE_ITEMS) -> None:
        self._queue: deque[Item] = deque()
        self._queue_items = queue_items
        self._overruns = 0
        self._arrived = threading.Condition()
        self._stopped = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="rtid-receive", daemon=True)

    @abstractmethod
    def _receive(self) -> Item | None:
        """One item, or None after POLL_S without any."""

    @abstractmethod
    def _convert(self, items: list[Item]) -> Frames:
        """Frames of these items."""

    @abstractmethod
    def _close(self) -> None:
        """Release the bus or line."""

    def start(self) -> Self:
        """Begin to receive."""
        self._thread.start()
        return self

    def read(self, timeout_s: float = POLL_S) -> Frames:
        """All frames received so far; waits for the first, at most timeout_s (then empty).

        Raises SourceError once everything received before the failure has been read.
        """
        with self._arrived:
            self._arrived.wait_for(self._is_due, timeout_s)
            items, overruns = list(self._queue), self._overruns
            self._queue.clear()
            self._overruns = 0
        if not items and self._error is not None:
            raise SourceError(f"receiving failed: {self._error}") from self._error
        frames = self._convert(items)
        fr.add_counts(frames.refused, {"overrun": overruns})
        return frames

    def __iter__(self) -> Iterator[Frames]:
        """Batches until `stop` is called and the queue is empty; never an empty batch."""
        while not self._stopped.is_set() or self._queue:
            frames = self.read()
            if len(frames) or frames.refused:
                yield frames

    def stop(self) -> None:
        """End the thread and release the bus; harmless when called again or from any state."""
        self._stopped.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(10 * POLL_S)
        with contextlib.suppress(Exception):  # an unplugged adapter cannot be closed properly
            self._close()

    def __enter__(self) -> Self:
        return self if self._thread.is_alive() else self.start()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def _is_due(self) -> bool:
        return bool(self._queue) or self._error is not None or self._stopped.is_set()

    def _run(self) -> None:
        try:
            while not self._stopped.is_set():
                item = self._receive()
                if item is not None:
                    self._put(item)
        except Exception as error:  # anything that drivers raise must reach the reader
            if not self._stopped.is_set():
                self._error = error
        with self._arrived:
            self._arrived.notify_all()

    def _put(self, item: Item) -> None:
        with self._arrived:
            if len(self._queue) >= self._queue_items:
                self._queue.popleft()
                self._overruns += 1
            self._queue.append(item)
            self._arrived.notify_all()
