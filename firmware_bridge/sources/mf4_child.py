"""The part of the MF4 reader that runs as a program of its own.

    python mf4_child.py log.mf4 SECONDS BYTES

SECONDS of processor time and BYTES that the log may unpack to are all that it gets.

A flipped bit in the index of a file has made asammdf's compiled part overwrite memory and abort
the process; in a child this costs the log and not the program.  The child knows nothing of this
package, so that it starts fast.  It writes the columns of all frames to stdout, a file, as .npz.
"""

from __future__ import annotations

import logging
import resource
import signal
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

FAILED, TOO_MUCH = 3, 4  # exit codes; stderr says why it failed
OUT_OF_TIME = signal.SIGXCPU  # what ends it then
WORKING_BYTES = 384 << 20  # beside what it unpacks: asammdf itself, and a block while it is read
AT_ONCE = 1 << 17  # records
CLASSIC_LENGTH, MAX_LENGTH = 8, 64
SMALLEST_RUN = 64  # records that are given up together
COUNTED = {  # groups without data frames
    "CAN_ErrorFrame": "error_frame",
    "CAN_RemoteFrame": "remote_frame",
    "CAN_OverloadFrame": "other_event",
}
KEYS = ("t_us", "channel", "can_id", "length", "data")  # the fields of Frames
Columns = dict[str, Any]  # NDArray each


def extract(path: str, max_bytes: int) -> tuple[Columns, dict[str, int]]:
    """Columns of all classic data frames, and what else the log holds, by reason.

    MemoryError if its records have more than max_bytes.
    """
    from asammdf import MDF  # noqa: PLC0415  an extra

    logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # it prints what it then raises
    parts: list[Columns] = []
    refused: dict[str, int] = {}
    with MDF(path, process_bus_logging=False) as mdf:
        start_us = round(mdf.start_time.timestamp() * 1e6)
        heads = [group.channel_group for group in mdf.groups]
        if sum(int(head.cycles_nr) * int(head.samples_byte_nr) for head in heads) > max_bytes:
            raise MemoryError
        for k in range(len(heads)):
            parts += _group(mdf, k, start_us, refused)
        if not parts and not any(refused.values()):
            return _channels(mdf), {}
    width = max((part["data"].shape[1] for part in parts), default=0)
    for part in parts:
        part["data"] = np.pad(part["data"], ((0, 0), (0, width - part["data"].shape[1])))
    keys = KEYS if parts else ()
    return {key: np.concatenate([part.pop(key) for part in parts]) for key in keys}, refused


def _channels(mdf: Any) -> Columns:
    """Every channel of numbers: titles, units (m,), and each one's stamps t0, t1, .. and values."""
    titles: list[str] = []
    units: list[str] = []
    columns: Columns = {}
    for k, group in enumerate(mdf.groups):
        for index, channel in enumerate(group.channels):
            values = None if index == mdf.masters_db.get(k) else _numbers(mdf, k, index)
            if values is None or not len(values):
                continue
            columns |= {f"t{len(titles)}": mdf.get_master(k), f"values{len(titles)}": values}
            titles.append(channel.name)
            units.append(channel.unit or "")
    return columns | {"titles": np.array(titles), "units": np.array(units)} if titles else {}


def _numbers(mdf: Any, k: int, index: int) -> Any:
    """Values of one channel, float64 (n,), NaN where invalid; None if it holds no numbers."""
    signal = mdf.get(group=k, index=index)
    values = np.asarray(signal.samples)
    if values.ndim != 1 or values.dtype.kind not in "iufb":
        return None
    values = values.astype(np.float64)
    if signal.invalidation_bits is not None:
        values[np.asarray(signal.invalidation_bits, bool)] = np.nan
    return values


def _group(mdf: Any, k: int, start_us: int, refused: dict[str, int]) -> list[Columns]:
    """Data frames of one channel group; what else it holds is counted in `refused`."""
    names = {channel.name for channel in mdf.groups[k].channels}
    count = int(mdf.groups[k].channel_group.cycles_nr)
    for name, reason in COUNTED.items():
        refused[reason] = refused.get(reason, 0) + count * (name in names)
    if "CAN_DataFrame" not in names or not count:
        return []
    parts, was_lost = [], False
    for first in range(0, count, AT_ONCE):
        for run in _runs(mdf, k, first, min(AT_ONCE, count - first)):
            if run is not None:
                parts.append(_columns(run, start_us, refused))
            elif not was_lost:
                refused["bad_container"] = refused.get("bad_container", 0) + 1
            was_lost = run is None
    return parts


def _runs(mdf: Any, k: int, first: int, count: int) -> Iterator[Any]:
    """Signals of consecutive records of group k; None for a run that cannot be read."""
    try:
        yield mdf.get("CAN_DataFrame", group=k, record_offset=first, record_count=count)
    except MemoryError:
        raise
    except Exception:  # asammdf raises whatever a damaged block causes
        if count <= SMALLEST_RUN:
            yield None
            return
        half = count // 2
        yield from _runs(mdf, k, first, half)
        yield from _runs(mdf, k, first + half, count - half)


def _columns(signal: Any, start_us: int, refused: dict[str, int]) -> Columns:
    """Columns of `Frames` from a CAN_DataFrame signal."""
    fields = {name.rpartition(".")[2]: name for name in signal.samples.dtype.names}
    length = signal.samples[fields["DataLength"]].astype(np.int64)
    keep = length <= MAX_LENGTH
    refused["fd_frame"] = refused.get("fd_frame", 0) + int((~keep).sum())
    kept = {key: signal.samples[name][keep] for key, name in fields.items()}
    width = CLASSIC_LENGTH if length[keep].max(initial=0) <= CLASSIC_LENGTH else MAX_LENGTH
    data = np.zeros((int(keep.sum()), width), np.uint8)
    payload = kept["DataBytes"][:, :width]
    data[:, : payload.shape[1]] = payload
    data[np.arange(width) >= length[keep, None]] = 0
    extended = kept["IDE"].astype(np.uint32) << np.uint32(31)
    return {
        "t_us": start_us + np.rint(signal.timestamps[keep] * 1e6).astype(np.int64),
        "channel": kept["BusChannel"].astype(np.uint8),
        "can_id": (kept["ID"].astype(np.uint32) & np.uint32(0x1FFF_FFFF)) | extended,
        "length": length[keep].astype(np.uint8),
        "data": data,
    }


def main() -> int:
    """Extract the log that the command line names; an exit code."""
    path, cpu_s, max_bytes = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    for kind, limit in (
        (resource.RLIMIT_CPU, cpu_s),
        (resource.RLIMIT_DATA, WORKING_BYTES + max_bytes),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        most = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (most, hard))
    try:
        columns, refused = extract(path, max_bytes)
    except MemoryError:
        return TOO_MUCH
    except Exception as error:  # asammdf raises whatever a damaged block causes
        sys.stderr.write(f"{error}\n")
        return FAILED
    columns |= {"reasons": list(refused), "counts": list(refused.values())}
    np.savez(sys.stdout.buffer, **columns)
    return 0


if __name__ == "__main__":
    sys.exit(main())
