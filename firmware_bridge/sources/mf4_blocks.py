"""The blocks of an MF4 file (ASAM MDF 4): its index, and the bytes that its records stand in.

A block is a head (kind, size, number of links), links to other blocks, and data.  Data groups link
to channel groups, these to channels; data stand in one block or in a list of them, plain or
deflated.  A deflated one that is damaged is left as a hole of its size, so that what follows keeps
its place.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.sources.unpacked import Budget

HEAD = struct.Struct("<4s4xQQ")  # kind, size with this head, number of links
PACKED = struct.Struct("<2sBxIQQ")  # kind inside, method, columns, size inside, packed size
DEFLATED, TRANSPOSED = 0, 1
FIRST = 64  # where the header block stands
UNFINISHED = b"UnFinMF "
UNFINISHED_FLAGS, LAST_SIZE = 60, 4  # place of what the writer left undone; the last DT's size
PLAIN = (b"##DT", b"##DV", b"##SD", b"##RD")


class DamagedError(ValueError):
    """A block that cannot be what its links say."""


class Block(NamedTuple):
    """Kind, links to other blocks (0: none) and data; `place` is where it begins in the file."""

    place: int
    kind: bytes
    links: tuple[int, ...]
    data: bytes


class Stream(NamedTuple):
    """Data of one group, uint8 (n,), the holes in it (begin, end), and whether its end is cut."""

    text: NDArray[np.uint8]
    holes: list[tuple[int, int]]
    is_cut: bool


class Blocks:
    """A whole file; raises DamagedError where a link leads to nothing.

    budget: of the bytes that its data may have.
    """

    def __init__(self, raw: bytes, budget: Budget) -> None:
        self._raw, self._budget = raw, budget
        self.is_finished = not raw.startswith(UNFINISHED)

    def at(self, place: int, *kinds: bytes) -> Block:
        """The block that begins there, of one of these kinds."""
        if place + HEAD.size > len(self._raw):
            raise DamagedError(
                f"truncated: it ends at byte {len(self._raw)}, before a part of its index"
            )
        kind, size, n = HEAD.unpack_from(self._raw, place)
        begin = place + HEAD.size + 8 * n
        if (kinds and kind not in kinds) or begin > len(self._raw) or size < HEAD.size + 8 * n:
            raise DamagedError(f"its index is damaged at byte {place}")
        links = struct.unpack_from(f"<{n}Q", self._raw, place + HEAD.size)
        return Block(place, kind, links, self._raw[begin : place + size])

    def chain(self, place: int, *kinds: bytes) -> Iterator[Block]:
        """A block and those that its first link leads to, one after the other."""
        seen: set[int] = set()
        while place:
            if place in seen:
                raise DamagedError(f"its index is damaged: a circle at byte {place}")
            seen.add(place)
            block = self.at(place, *kinds)
            yield block
            place = block.links[0]

    def text(self, place: int) -> str:
        """What a block of text says; "" where there is none."""
        words = self.at(place, b"##TX", b"##MD").data if place else b""
        return words.split(b"\0")[0].decode(errors="replace")

    def stream(self, place: int) -> Stream:
        """All data that a data group, or a channel of long values, links to."""
        text, holes, is_cut = bytearray(), list[tuple[int, int]](), False
        for block, stated in self._data(place):
            content, is_whole = self._content(block)
            size = stated or max(len(content), _inner_size(block))
            self._budget.take(size)
            if not is_whole or len(content) != size:
                holes.append((len(text) + len(content) * is_whole, len(text) + size))
                content = (content if is_whole else b"").ljust(size, b"\0")[:size]
            text += content
            is_cut |= block.kind in PLAIN and self._is_cut(block)
        return Stream(np.frombuffer(text, np.uint8), holes, is_cut)

    def _data(self, place: int) -> Iterator[tuple[Block, int]]:
        """Blocks of data with the size that a list says that they have inside (0: it does not)."""
        if not place:
            return
        head = self.at(place, *PLAIN, b"##DZ", b"##HL", b"##DL")
        if head.kind == b"##HL":
            head = self.at(head.links[0], b"##DL")
        if head.kind != b"##DL":
            yield head, 0
            return
        for block in self.chain(head.place, b"##DL"):
            flags, count = struct.unpack_from("<B3xI", block.data)
            equal = struct.unpack_from("<Q", block.data, 8)[0] if flags & 1 else 0
            for k, link in enumerate(block.links[1 : count + 1]):
                is_last = not block.links[0] and k + 1 == count
                yield self.at(link, *PLAIN, b"##DZ"), 0 if is_last else equal

    def _content(self, block: Block) -> tuple[bytes, bool]:
        """What a block of data holds, and whether that is all right."""
        if block.kind in PLAIN:
            return (
                self._raw[block.place + HEAD.size :] if self._is_open(block) else block.data
            ), True
        _, method, columns, size, _ = PACKED.unpack_from(block.data)
        if method not in (DEFLATED, TRANSPOSED):
            raise DamagedError(f"compressed by method {method} of MDF 4.3, which is not read")
        engine = zlib.decompressobj()
        try:
            content = engine.decompress(block.data[PACKED.size :], self._budget.left + 1)
        except zlib.error:
            return b"", False
        if method == TRANSPOSED and columns:
            content = _transposed(content, columns)
        return content, engine.eof and len(content) == size

    def _is_open(self, block: Block) -> bool:
        """Whether a block goes on to the end of the file: its writer has not said its size."""
        if self.is_finished or not block.data:
            return not self.is_finished
        (flags,) = struct.unpack_from("<H", self._raw, UNFINISHED_FLAGS)
        return bool(flags & LAST_SIZE) and self._raw.rfind(b"##DT") == block.place

    def _is_cut(self, block: Block) -> bool:
        return block.place + HEAD.unpack_from(self._raw, block.place)[1] > len(self._raw)


def _inner_size(block: Block) -> int:
    """What a damaged block says that it holds."""
    return PACKED.unpack_from(block.data)[3] if block.kind == b"##DZ" else 0


def _transposed(content: bytes, columns: int) -> bytes:
    """Records from their bytes in columns; what is left over stands behind, as it is."""
    whole = len(content) // columns * columns
    table = np.frombuffer(content[:whole], np.uint8).reshape(columns, -1)
    return table.T.tobytes() + content[whole:]
