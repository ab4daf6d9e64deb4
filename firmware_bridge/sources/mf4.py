"""MF4 bus logs (ASAM MDF 4), through asammdf, which is an extra: pip install rtid[mf4].

The index of a file may stand before its data (loggers) or behind (converters, asammdf, python-can).
Of a log that is cut, all is read in the first case ("not_finalised": nothing says where such a log
should end), nothing can be in the second: that is an error which says "truncated".  Compressed
blocks carry a checksum: a damaged one is skipped and counted.  Uncompressed data, the heads of
blocks and the index carry none: damage there may yield wrong frames.  Stamps are rounded to 1 us.
"""

from __future__ import annotations

import importlib.util
import io
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources import mf4_child
from firmware_bridge.sources.errors import LogError

FIRST_GROUP, GROUP_DATA = 88, 40  # where the links to the first data group and to its data stand
LIMIT_S, BYTES_PER_S = 10.0, 2e6  # a reader that is slower than this has lost its way


def read(path: Path) -> Frames:
    """All classic data frames of a bus-logging MF4, sorted by time; LogError if it holds none."""
    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{path}: reading MF4 needs asammdf; pip install 'rtid[mf4]'")
    finalised = _check_index(path)
    columns, refused = _extract(path)
    if len(columns.get("t_us", ())) == 0:
        lost = "all its blocks are damaged" if refused.get("bad_container") else "is it a bus log?"
        raise LogError(f"{path}: holds no CAN data frames; {lost}")
    found = fr.by_time(Frames(**columns))
    fr.add_counts(found.refused, refused | {"not_finalised": int(not finalised)})
    return found


def _check_index(path: Path) -> bool:
    """Whether the log was closed by its writer; LogError if its index or data lie behind its end.

    asammdf would say so less plainly.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        place, head = 0, file.read(FIRST_GROUP + 8)
        if not head.startswith((b"MDF ", b"UnFinMF ")):
            raise LogError(f"{path}: not an MF4 file; check the file or its suffix")
        for offset in (FIRST_GROUP, GROUP_DATA):
            file.seek(place + offset)
            link = file.read(8)
            place = struct.unpack("<Q", link)[0] if len(link) == 8 else size
            if place >= size:
                raise LogError(
                    f"{path}: truncated: it ends at byte {size}, before its index or first frame; "
                    "copy the log again"
                )
    return head.startswith(b"MDF ")


def _extract(path: Path) -> tuple[mf4_child.Columns, dict[str, int]]:
    """`mf4_child.extract` in a process of its own; LogError if it fails, crashes or hangs."""
    limit_s = LIMIT_S + path.stat().st_size / BYTES_PER_S
    try:
        done = subprocess.run(
            [sys.executable, "-P", mf4_child.__file__, str(path)],
            capture_output=True, check=False, timeout=limit_s,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise LogError(f"{path}: not read in {limit_s:.0f} s; its index is damaged") from None
    if done.returncode == mf4_child.FAILED:
        why = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise LogError(f"{path}: not a readable MF4 bus log: {why}")
    if done.returncode:
        raise LogError(f"{path}: asammdf crashed ({done.returncode}); the log's index is damaged")
    with np.load(io.BytesIO(done.stdout)) as arrays:
        columns = dict(arrays)
    reasons, counts = columns.pop("reasons").tolist(), columns.pop("counts").tolist()
    return columns, dict(zip(reasons, map(int, counts), strict=True))
