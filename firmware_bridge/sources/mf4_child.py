"""The part of the MF4 reader that runs as a program of its own, `python mf4_child.py log.mf4`.

A flipped bit in the index of a file has made asammdf's compiled part overwrite memory and abort
the process; in a child this costs the log and not the program.  The child knows nothing of this
package, so that it starts fast.  It writes the columns of all frames to stdout as .npz.
"""

from __future__ import annotations

import io
import itertools
import logging
import sys
from typing import Any

import numpy as np

FAILED = 3  # exit code; stderr says why
MAX_LENGTH = 8
SMALLEST_RUN = 64  # records that are given up together
COUNTED = {  # groups without data frames
    "CAN_ErrorFrame": "error_frame",
    "CAN_RemoteFrame": "remote_frame",
    "CAN_OverloadFrame": "other_event",
}
KEYS = ("t_us", "channel", "can_id", "length", "data")  # the fields of Frames
Columns = dict[str, Any]  # NDArray each


def extract(path: str) -> tuple[Columns, dict[str, int]]:
    """Columns of all classic data frames, and what else the log holds, by reason."""
    from asammdf import MDF  # noqa: PLC0415  an extra

    logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # it prints what it then raises
    parts: list[Columns] = []
    refused: dict[str, int] = {}
    with MDF(path, process_bus_logging=False) as mdf:
        start_us = round(mdf.start_time.timestamp() * 1e6)
        for k in range(len(mdf.groups)):
            parts += _group(mdf, k, start_us, refused)
    return {key: np.concatenate([part[key] for part in parts]) for key in KEYS if parts}, refused


def _group(mdf: Any, k: int, start_us: int, refused: dict[str, int]) -> list[Columns]:
    """Data frames of one channel group; what else it holds is counted in `refused`."""
    names = {channel.name for channel in mdf.groups[k].channels}
    count = int(mdf.groups[k].channel_group.cycles_nr)
    for name, reason in COUNTED.items():
        refused[reason] = refused.get(reason, 0) + count * (name in names)
    if "CAN_DataFrame" not in names or not count:
        return []
    runs = _runs(mdf, k, 0, count)
    lost = [run is None for run in runs]
    bad = sum(b and not a for a, b in itertools.pairwise([False, *lost]))
    refused["bad_container"] = refused.get("bad_container", 0) + bad
    return [_columns(run, start_us, refused) for run in runs if run is not None]


def _runs(mdf: Any, k: int, first: int, count: int) -> list[Any]:
    """Signals of consecutive records of group k; None for a run that cannot be read."""
    try:
        return [mdf.get("CAN_DataFrame", group=k, record_offset=first, record_count=count)]
    except Exception:  # asammdf raises whatever a damaged block causes
        if count <= SMALLEST_RUN:
            return [None]
    half = count // 2
    return _runs(mdf, k, first, half) + _runs(mdf, k, first + half, count - half)


def _columns(signal: Any, start_us: int, refused: dict[str, int]) -> Columns:
    """Columns of `Frames` from a CAN_DataFrame signal, without long CAN FD frames."""
    fields = {name.rpartition(".")[2]: name for name in signal.samples.dtype.names}
    length = signal.samples[fields["DataLength"]].astype(np.int64)
    keep = length <= MAX_LENGTH
    refused["fd_frame"] = refused.get("fd_frame", 0) + int((~keep).sum())
    kept = {key: signal.samples[name][keep] for key, name in fields.items()}
    data = np.zeros((int(keep.sum()), MAX_LENGTH), np.uint8)
    held = kept["DataBytes"][:, :MAX_LENGTH]
    data[:, : held.shape[1]] = held
    data[np.arange(MAX_LENGTH) >= length[keep, None]] = 0
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
    try:
        columns, refused = extract(sys.argv[1])
    except Exception as error:  # asammdf raises whatever a damaged block causes
        sys.stderr.write(f"{error}\n")
        return FAILED
    content = io.BytesIO()
    np.savez(content, reasons=list(refused), counts=list(refused.values()), **columns)
    sys.stdout.buffer.write(content.getbuffer())
    return 0


if __name__ == "__main__":
    sys.exit(main())
