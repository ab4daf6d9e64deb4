"""How much a container may unpack to: a file of one megabyte can hold a gigabyte of one byte.

Recordings of real signals shrink to a fifth, at rest to a hundredth; deflate can do 1/1032.
"""

from __future__ import annotations

from pathlib import Path

from firmware_bridge.sources.errors import LogError

MAX_BYTES = 500_000_000  # of a BLF log 10.4 million frames: an hour at 2,900 frames a second
FREE_BYTES = 64_000_000  # below this no ratio is too large
MAX_RATIO = 250


class Budget:
    """What is left of the bytes that one file may unpack to."""

    def __init__(self, path: Path) -> None:
        self._path, self._size = path, path.stat().st_size
        self.limit = self.left = min(MAX_BYTES, max(FREE_BYTES, MAX_RATIO * self._size))

    def take(self, n_bytes: int) -> None:
        """Account for unpacked bytes; LogError where there are more than the file may have."""
        self.left -= n_bytes
        if self.left < 0:
            raise self.exceeded()

    def exceeded(self) -> LogError:
        """Say that the file unpacks to too much."""
        is_long = self.limit == MAX_BYTES
        remedy = "cut it into shorter ones" if is_long else "is it damaged, or made to do harm?"
        limit = f"{self.limit // 10**6} MB"
        return LogError(
            f"{self._path}: its {self._size} bytes unpack to more than {limit}; {remedy}"
        )
