"""MF4 (ASAM MDF 4), through asammdf, which is an extra: pip install rtid[mf4].

A log of a bus is read as frames.  Of a plain measurement every channel of numbers is read as a
column, at the stamps of the group that has most of them; the others are interpolated to them.

The index of a file may stand before its data (loggers) or behind (converters, asammdf, python-can).
Of a log that is cut, all is read in the first case ("not_finalised": nothing says where such a log
should end), nothing can be in the second: that is an error which says "truncated".  Compressed
blocks carry a checksum: a damaged one is skipped and counted.  Uncompressed data, the heads of
blocks and the index carry none: damage there may yield wrong frames.  Stamps are rounded to 1 us.
"""

from __future__ import annotations

import struct
import subprocess
import sys
from importlib.machinery import PathFinder
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources import mf4_child
from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.merged import Channel, merged
from firmware_bridge.sources.table import Table
from firmware_bridge.sources.unpacked import Budget

FIRST_GROUP, GROUP_DATA = 88, 40  # where the links to the first data group and to its data stand
CPU_S, BYTES_PER_CPU_S = 10.0, 2e6  # of processor time: a load of the machine costs none


def read(path: Path) -> Frames | Table:
    """All data frames of a bus-logging MF4, sorted by time, else its channels as a table."""
    if PathFinder.find_spec("asammdf") is None:
        raise LogError(f"{path}: reading MF4 needs asammdf; pip install 'rtid[mf4]'")
    finalised = _check_index(path)
    columns, refused = _extract(path)
    if "titles" in columns:
        named = zip(columns["titles"].tolist(), columns["units"].tolist(), strict=True)
        return merged(path, [
            Channel(title, unit, columns[f"t{k}"], columns[f"values{k}"])
            for k, (title, unit) in enumerate(named)
        ])  # fmt: skip
    known = ("fd_frame", *mf4_child.COUNTED.values())
    if not columns and not any(refused.get(kind) for kind in known):
        lost = "all its blocks are damaged" if refused.get("bad_container") else "is it empty?"
        raise LogError(f"{path}: holds neither CAN frames nor channels of numbers; {lost}")
    frames = fr.by_time(Frames(**columns)) if columns else fr.empty(0)
    fr.add_counts(frames.refused, refused | {"not_finalised": int(not finalised)})
    return frames


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
    budget = Budget(path)
    cpu_s = CPU_S + path.stat().st_size / BYTES_PER_CPU_S
    limits = [str(round(cpu_s)), str(budget.limit)]
    with TemporaryFile() as answer:
        done = subprocess.run(
            [sys.executable, "-P", mf4_child.__file__, str(path), *limits],
            stdout=answer, stderr=subprocess.PIPE, check=False,
        )  # fmt: skip
        _check_end(done, path, cpu_s, budget)
        answer.seek(0)
        with np.load(answer) as arrays:
            columns = dict(arrays)
    reasons, counts = columns.pop("reasons").tolist(), columns.pop("counts").tolist()
    return columns, dict(zip(reasons, map(int, counts), strict=True))


def _check_end(
    done: subprocess.CompletedProcess[bytes], path: Path, cpu_s: float, budget: Budget
) -> None:
    """LogError unless the child ended well."""
    if done.returncode == mf4_child.FAILED:
        why = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise LogError(f"{path}: not a readable MF4 bus log: {why}")
    if done.returncode == mf4_child.TOO_MUCH:
        raise budget.exceeded()
    if done.returncode == -mf4_child.OUT_OF_TIME:
        spent = f"not read in {cpu_s:.0f} s of processor time"
        raise LogError(f"{path}: {spent}; its index is damaged")
    if done.returncode:
        raise LogError(f"{path}: asammdf crashed ({done.returncode}); the log's index is damaged")
