"""Objects to and from a helper process; arrays travel as they lie in memory, beside the pickle.

What is large goes through memory that both ends see: in pieces of a socket's buffer a snapshot
would have to wait for the processor a hundred times.  Both ends are ours: one is inherited by a
process that this one has started.
"""

from __future__ import annotations

import os
import pickle
import socket
from itertools import accumulate
from multiprocessing.connection import Connection
from typing import Any

LARGE_BYTES = 1 << 16  # from here on
ALIGNED = 64  # where a buffer begins


class Pipe:
    """One end; `send` from one thread, `receive` from one thread."""

    def __init__(self, fd: int) -> None:
        self._connection: Connection[Any, Any] = Connection(fd)
        self._socket = socket.socket(fileno=os.dup(fd))

    def send(self, value: object) -> None:
        """Send an object; OSError if the other end is gone."""
        buffers: list[pickle.PickleBuffer] = []
        head = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        raw = [buffer.raw() for buffer in buffers]
        sizes = [part.nbytes for part in raw]
        is_large = sum(sizes) > LARGE_BYTES
        self._connection.send_bytes(pickle.dumps((sizes, is_large, head)))
        if is_large:
            self._share(raw)
            return
        for part in raw:
            self._connection.send_bytes(part)

    def _share(self, raw: list[memoryview]) -> None:
        with open(os.memfd_create("rtid"), "r+b", buffering=0) as file:
            for part in raw:
                file.write(part)
                file.seek(-part.nbytes % ALIGNED, os.SEEK_CUR)
            file.truncate()
            socket.send_fds(self._socket, [b"m"], [file.fileno()])

    def receive(self) -> Any:
        """The next object; waits.  EOFError or OSError if the other end is gone."""
        sizes, is_large, head = pickle.loads(self._connection.recv_bytes())
        if is_large:
            return pickle.loads(head, buffers=self._shared(sizes))
        buffers = [bytearray(self._connection.recv_bytes()) for _ in sizes]
        return pickle.loads(head, buffers=buffers)

    def _shared(self, sizes: list[int]) -> list[memoryview]:
        """Copies of what is shared: a mapping would keep the file open as long as it is used."""
        _, fds, _, _ = socket.recv_fds(self._socket, 1, 1)
        if not fds:
            raise EOFError
        begins = [0, *accumulate(size + -size % ALIGNED for size in sizes)]
        whole = memoryview(bytearray(begins.pop()))
        with open(fds[0], "rb", buffering=0) as file:
            file.seek(0)
            at = 0
            while at < len(whole) and (count := file.readinto(whole[at:])):
                at += count
        return [whole[at : at + size] for at, size in zip(begins, sizes, strict=True)]

    def close(self) -> None:
        """Close this end; harmless when called again."""
        if not self._connection.closed:
            self._connection.close()
            self._socket.close()


def pair() -> tuple[int, int]:
    """File descriptors of two ends; the second one is for a process to inherit."""
    ours, theirs = socket.socketpair()
    return ours.detach(), theirs.detach()
