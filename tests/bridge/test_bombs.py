"""Containers that unpack to a thousand times their size: a named error, in bounded memory."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from can.io.mf4 import STD_DTYPE
from scipy.io import savemat

from firmware_bridge import frames as fr
from firmware_bridge.sources import LogError, blf, open_log, read_table
from firmware_bridge.sources.unpacked import FREE_BYTES, MAX_BYTES, MAX_RATIO
from rtid.maps.files import MapFileError, read_map

MAX_RSS_BYTES, MAX_CPU_S = 1e9, 20.0
HALF = FREE_BYTES // 16  # numbers of which two columns pass what a small file may unpack to
MEASURE = """
import json, re, resource, sys
from pathlib import Path
from rtid.cli.main import main
try: main()
finally:
    used = resource.getrusage(resource.RUSAGE_SELF)
    status = Path("/proc/self/status").read_text()  # ru_maxrss would be that of the parent
    peak_kib = int(re.search(r"VmHWM:\\s*(\\d+)", status)[1])
    print(json.dumps([1024 * peak_kib, used.ru_utime + used.ru_stime]), file=sys.stderr)
"""


def blf_of(content: bytes, times: int) -> bytes:
    """A BLF file of so many containers with the same content."""
    packed = zlib.compress(content, 9)
    size = blf.OBJECT.size + blf.CONTAINER.size + len(packed)
    head = blf.OBJECT.pack(b"LOBJ", blf.OBJECT.size, 1, size, blf.CONTAINER_TYPE)
    one = head + blf.CONTAINER.pack(blf.DEFLATED, len(content)) + packed + bytes(size % 4)
    return b"LOGG".ljust(blf.HEADER_BYTES, b"\0") + one * times


def most_frames_blf(path: Path) -> int:
    """As many frames as a file may hold, in one of the least size for them; their number."""
    frames = fr.empty(1 << 16)
    frames.length[:] = 8
    times = MAX_BYTES // (len(frames) * blf.CAN_OBJECT.itemsize)
    noise = np.random.default_rng(1).bytes(MAX_BYTES // MAX_RATIO)
    path.write_bytes(blf_of(blf._inner(frames, 0).tobytes(), times) + noise)
    return times * len(frames)


def zeros_blf(path: Path) -> None:
    path.write_bytes(blf_of(bytes(8 << 20), FREE_BYTES >> 22))


def huge_container_blf(path: Path) -> None:
    path.write_bytes(blf_of(bytes(200 << 20), 1))


def zeros_parquet(path: Path) -> None:
    zeros = pa.array(np.zeros(HALF + 1))
    pq.write_table(pa.table({"t": zeros, "p_a": zeros}), path, compression="gzip")


def zeros_mat(path: Path) -> None:
    savemat(path, {"t": np.zeros(2 * HALF + 1)}, do_compression=True)


def bytes_mat(path: Path) -> None:
    """One byte in the file becomes a number of eight."""
    savemat(path, {"t": np.zeros(2 * HALF + 1, np.int8)}, do_compression=True)


def lying_mat(path: Path) -> None:
    """Ten numbers are told, and gigabytes may follow."""
    savemat(path, {"t": np.zeros(2 * HALF)})
    raw = bytearray(path.read_bytes())
    place = raw.index(struct.pack("<ii", 1, 2 * HALF))
    raw[place : place + 8] = struct.pack("<ii", 1, 10)
    packed = zlib.compress(raw[128:], 9)
    path.write_bytes(raw[:128] + struct.pack("<II", 15, len(packed)) + packed)


def zeros_mf4(path: Path) -> None:
    log = can.MF4Writer(path, compression_level=2)
    log.on_message_received(can.Message(timestamp=1.7e9, data=b"12345678"))
    n = FREE_BYTES // STD_DTYPE.itemsize
    log._mdf.extend(0, [(np.ones(n), None), (np.zeros(n, STD_DTYPE), None)])
    log.stop()


def huge_block_mf4(path: Path) -> None:
    """A compressed block of a log is replaced by one of a gigabyte; the number of records stays."""
    with can.MF4Writer(path, compression_level=2) as log:
        for k in range(2000):
            log.on_message_received(can.Message(timestamp=1.7e9 + k, data=b"12345678"))
    raw = path.read_bytes()
    place, new = raw.index(b"##DZ"), len(raw) + -len(raw) % 8
    engine, piece = zlib.compressobj(9), bytes(1 << 24)
    packed = b"".join([engine.compress(piece) for _ in range(64)]) + engine.flush()
    head = struct.pack(
        "<4sIQQ2sBBIQQ", b"##DZ", 0, 48 + len(packed), 0, b"DT", 0, 0, 0, 1 << 30, len(packed)
    )
    linked = raw.replace(struct.pack("<Q", place), struct.pack("<Q", new))
    path.write_bytes(linked.ljust(new, b"\0") + head + packed)


BOMBS: dict[str, Callable[[Path], None]] = {
    "zeros.blf": zeros_blf,
    "container.blf": huge_container_blf,
    "zeros.parquet": zeros_parquet,
    "zeros.mat": zeros_mat,
    "bytes.mat": bytes_mat,
    "lying.mat": lying_mat,
    "zeros.mf4": zeros_mf4,
    "block.mf4": huge_block_mf4,
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_by_name(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    BOMBS[name](path)
    assert path.stat().st_size < 2 << 20
    begin_s = time.process_time()
    with pytest.raises(LogError, match=r"bytes unpack to more than \d+ MB"):
        (read_table if path.suffix in (".parquet", ".mat") else open_log)(path)
    assert time.process_time() - begin_s < MAX_CPU_S


def test_a_map_that_unpacks_to_too_much_is_refused_by_name(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "map.npz", header=np.zeros(2 * HALF + 1))
    with pytest.raises(MapFileError, match=r"bytes unpack to more than \d+ MB"):
        read_map(tmp_path / "map.npz")


@pytest.mark.long
@pytest.mark.slow
def test_the_longest_log_takes_less_than_a_gigabyte(tmp_path: Path) -> None:
    count = most_frames_blf(tmp_path / "t.blf")
    command = [sys.executable, "-c", MEASURE, "check", "--bus-only", str(tmp_path / "t.blf")]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, check=False)
    assert json.loads(done.stdout)["frames"] == count > 10_000_000
    rss_bytes, cpu_s = json.loads(done.stderr.splitlines()[-1])
    print(f"peak {1e-6 * rss_bytes:.0f} MB, {cpu_s:.1f} s of processor time")
    assert rss_bytes < MAX_RSS_BYTES and cpu_s < MAX_CPU_S


def test_text_columns_are_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    text = pa.chunked_array([pa.array(["x" * 1_000_000] * 100)] * 3)
    table = pa.table({"t": pa.array(np.arange(300.0)), "note": text})
    pq.write_table(table, path, compression="gzip")
    assert list(read_table(path).columns) == ["t"]
