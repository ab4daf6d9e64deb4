"""Small files that unpack to more than a gigabyte: what a container holds must be bounded."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet

CHUNK = bytes(64 << 20)
CHUNKS = 20  # 1.3 GB in all


def blf(path: Path) -> None:
    """Containers of zeros behind the sound ones of a log."""
    packed = zlib.compress(CHUNK, 1)
    head = struct.pack("<4sHHII", b"LOBJ", 16, 1, 32 + len(packed), 10)
    container = head + struct.pack("<HHIII", 2, 0, 0, len(CHUNK), 0) + packed
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(content + (container + bytes(len(container) % 4)) * CHUNKS)


def gz(path: Path) -> None:
    """As many members of zeros, one after the other."""
    path.unlink()
    path.write_bytes(gzip.compress(CHUNK, 1) * CHUNKS)


def parquet(path: Path) -> None:
    """Columns of zeros, of which the file holds little more than the count."""
    path.unlink()
    zeros = pa.array(np.zeros(4_000_000))
    group = pa.table({name: zeros for name in ("t", "u", "p_a", "p_b", "p_supply", "x")})
    with pyarrow.parquet.ParquetWriter(path, group.schema) as file:
        for _ in range(7):
            file.write_table(group)


def mat(path: Path) -> None:
    """One compressed matrix of zeros."""
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49)
    count = len(CHUNK) * CHUNKS // 8
    flags, shape = struct.pack("<IIII", 6, 8, 6, 0), struct.pack("<IIii", 5, 8, 1, count)
    inner = flags + shape + struct.pack("<HH4s", 1, 1, b"t") + struct.pack("<II", 9, 8 * count)
    packer = zlib.compressobj(1)
    parts = [packer.compress(struct.pack("<II", 14, len(inner) + 8 * count) + inner)]
    parts += [packer.compress(CHUNK) for _ in range(CHUNKS)]
    packed = b"".join([*parts, packer.flush()])
    path.unlink()
    path.write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)


BOMBS: dict[str, Callable[[Path], None]] = {
    "log.blf": blf,
    "log.asc.gz": gz,
    "table.parquet": parquet,
    "table.mat": mat,
}
