"""Hands the controller's answers on to an `rtid apply` in another process.

On a serial line only one process can read: the daemon.  The other one writes to the line itself and
listens at a socket in the state folder, which exists only while it waits for answers.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from firmware_bridge.frames import EXTENDED, Frames
from rtid.errors import RtidError
from rtid.project import Project

FILE = "answers.sock"
SHORT = 0x7FF  # larger identifiers have 29 bits


class Answers:
    """Takes frames as they arrive, in the loop: never waits, and sends nowhere but to FILE."""

    def __init__(self, folder: Path, reply_id: int) -> None:
        self._path, self._reply_id = str(folder / FILE), np.uint32(reply_id)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def close(self) -> None:
        """Hand nothing on any more."""
        self._socket.close()

    def take(self, frames: Frames) -> None:
        """Hand on those with the identifier of answers."""
        mine = frames.can_id == self._reply_id
        if mine.any():
            for data, length in zip(frames.data[mine], frames.length[mine], strict=True):
                with contextlib.suppress(OSError):  # nobody listens any more, or too slowly
                    self._socket.sendto(data[:length].tobytes(), self._path)


def answers_of(project: Project, folder: Path, interface: str) -> Answers | None:
    """None where nothing is ever sent, or where the other process can hear for itself."""
    reply_id = project.sections.publish.reply_id
    if reply_id is None or interface != "serial":
        return None
    return Answers(folder, reply_id | EXTENDED if reply_id > SHORT else reply_id)


@contextlib.contextmanager
def heard(folder: Path) -> Iterator[socket.socket]:
    """A socket at which the daemon's answers arrive until the block ends."""
    path = folder / FILE
    path.unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        try:
            listening.bind(str(path))
        except OSError as error:
            raise RtidError(
                f"{path}: {error}", "name a shorter state folder with --state"
            ) from None
        os.chmod(path, 0o600)
        try:
            yield listening
        finally:
            path.unlink(missing_ok=True)
