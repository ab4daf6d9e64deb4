"""MF4 (ASAM MDF 4): logs of a bus by `mf4_bus`, plain measurements through asammdf.

Of a plain measurement every channel of numbers is read as a column, at the stamps of the group that
has most of them; the others are interpolated to them.  asammdf is an extra: pip install rtid[mf4].

The index of a file may stand before its data (loggers) or behind (converters, asammdf, python-can).
Of a log that is cut, all is read in the first case ("not_finalised": nothing says where such a log
should end), nothing can be in the second: that is an error which says "truncated".  Compressed
blocks carry a checksum: a damaged one is skipped and counted.  Uncompressed data, the heads of
blocks and the index carry none: damage there may yield wrong frames.
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
from firmware_bridge.sources import mf4_bus, mf4_child
from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.merged import Channel, merged
from firmware_bridge.sources.mf4_blocks import UNFINISHED, Blocks, DamagedError
from firmware_bridge.sources.table import Table
from firmware_bridge.sources.unpacked import Budget

CPU_S, BYTES_PER_CPU_S = 10.0, 2e6  # of processor time: a load of the machine costs none
DAMAGE = (DamagedError, KeyError, IndexError, ValueError, OverflowError, struct.error)


def read(path: Path) -> Frames | Table:
    """All data frames of an MF4 log, sorted by time; of any other MF4 its channels as a table."""
    raw = path.read_bytes()
    if not raw.startswith((b"MDF ", UNFINISHED)):
        raise LogError(f"{path}: not an MF4 file; check the file or its suffix")
    if raw[8:9] in (b"2", b"3"):
        raise LogError(f"{path}: MDF 3; write it as MF4: MDF(...).convert('4.10') of asammdf")
    blocks = Blocks(raw, Budget(path))
    try:
        frames = mf4_bus.read(blocks)
    except LogError:  # too large, which is a ValueError too
        raise
    except DAMAGE as error:
        why = error if isinstance(error, DamagedError) else "its index is damaged"
        raise LogError(f"{path}: {why}; copy the log again") from error
    if frames is None:
        return _measurement(path)
    if not len(frames) and not frames.refused:
        raise LogError(f"{path}: holds no CAN frames; is it empty?")
    fr.add_counts(frames.refused, {"not_finalised": int(not blocks.is_finished)})
    return fr.by_time(frames)


def _measurement(path: Path) -> Table:
    """The channels of a plain measurement."""
    if PathFinder.find_spec("asammdf") is None:
        raise LogError(f"{path}: reading a measurement needs asammdf; pip install 'rtid[mf4]'")
    columns = _extract(path)
    if not columns:
        raise LogError(f"{path}: holds neither CAN frames nor channels of numbers; is it empty?")
    named = zip(columns["titles"].tolist(), columns["units"].tolist(), strict=True)
    return merged(path, [
        Channel(title, unit, columns[f"t{k}"], columns[f"values{k}"])
        for k, (title, unit) in enumerate(named)
    ])  # fmt: skip


def _extract(path: Path) -> mf4_child.Columns:
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
            return dict(arrays)


def _check_end(
    done: subprocess.CompletedProcess[bytes], path: Path, cpu_s: float, budget: Budget
) -> None:
    """LogError unless the child ended well."""
    if done.returncode == mf4_child.FAILED:
        why = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise LogError(f"{path}: not a readable MF4: {why}")
    if done.returncode == mf4_child.TOO_MUCH:
        raise budget.exceeded()
    if done.returncode == -mf4_child.OUT_OF_TIME:
        spent = f"not read in {cpu_s:.0f} s of processor time"
        raise LogError(f"{path}: {spent}; its index is damaged")
    if done.returncode:
        raise LogError(f"{path}: asammdf crashed ({done.returncode}); the log's index is damaged")
