"""Objects to and from a helper process; arrays travel as they lie in memory, beside the pickle.

Both ends are ours: one is inherited by a process that this one has started.
"""

from __future__ import annotations

import pickle
import socket
from multiprocessing.connection import Connection
from typing import Any


class Pipe:
    """One end; `send` from one thread, `receive` from one thread."""

    def __init__(self, fd: int) -> None:
        self._connection: Connection[Any, Any] = Connection(fd)

    def send(self, value: object) -> None:
        """Send an object; OSError if the other end is gone."""
        buffers: list[pickle.PickleBuffer] = []
        head = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        self._connection.send_bytes(len(buffers).to_bytes(4, "little"))
        self._connection.send_bytes(head)
        for buffer in buffers:
            self._connection.send_bytes(buffer.raw())

    def receive(self) -> Any:
        """The next object; waits.  EOFError or OSError if the other end is gone."""
        count = int.from_bytes(self._connection.recv_bytes(), "little")
        head = self._connection.recv_bytes()
        buffers = [bytearray(self._connection.recv_bytes()) for _ in range(count)]
        return pickle.loads(head, buffers=buffers)

    def close(self) -> None:
        """Close this end; harmless when called again."""
        if not self._connection.closed:
            self._connection.close()


def pair() -> tuple[int, int]:
    """File descriptors of two ends; the second one is for a process to inherit."""
    ours, theirs = socket.socketpair()
    return ours.detach(), theirs.detach()
