"""What goes from one process to another: its large arrays lie in a file that both map.

A record of ten minutes and all that is made of it would otherwise be in memory twice, and four
times while it is sent.
"""

from __future__ import annotations

import mmap
import pickle
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any, BinaryIO, cast
from weakref import WeakSet

LARGE = 2**16  # bytes of an array that is worth a place of its own
ALIGNED = 64
_MAPPED: WeakSet[mmap.mmap] = WeakSet()  # files of parcels whose arrays somebody has


@dataclass(frozen=True)
class Parcel:
    """A pickled value; spans: first and last byte of its large arrays in a file, None without."""

    content: bytes
    file: Path | None
    spans: tuple[tuple[int, int], ...]

    def value(self) -> Any:
        """The value, once; its large arrays are those of the file, and cannot be written to."""
        if self.file is None:
            return pickle.loads(self.content)
        with self.file.open("rb") as opened:
            mapped = mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ)
        _MAPPED.add(mapped)
        whole = memoryview(mapped)
        with suppress(OSError):  # where what is mapped cannot go, it goes with its folder
            self.file.unlink()
        return pickle.loads(self.content, buffers=[whole[a:b] for a, b in self.spans])


def unread() -> None:
    """Let go of what was read of all parcels: who reads it again finds it in their files.

    Pictures read a record's arrays through once, 40 MB of ten minutes, and then a window of them.
    """
    for mapped in list(_MAPPED):
        with suppress(AttributeError, OSError, ValueError):  # another system
            mapped.madvise(mmap.MADV_DONTNEED)


def packed(value: object, folder: Path) -> Parcel:
    """A value as it travels, its large arrays in a new file of the folder."""
    large: list[pickle.PickleBuffer] = []

    def stays(buffer: pickle.PickleBuffer) -> bool:
        if buffer.raw().nbytes < LARGE:
            return True
        large.append(buffer)
        return False

    content = pickle.dumps(value, protocol=5, buffer_callback=stays)
    if not large:
        return Parcel(content, None, ())
    with NamedTemporaryFile(dir=folder, delete=False) as file:
        spans = tuple(_written(cast("BinaryIO", file), buffer) for buffer in large)
    return Parcel(content, Path(file.name), spans)


def _written(file: BinaryIO, buffer: pickle.PickleBuffer) -> tuple[int, int]:
    """Where an array lies."""
    file.write(bytes(-file.tell() % ALIGNED))
    begin = file.tell()
    file.write(buffer.raw())
    return begin, file.tell()
