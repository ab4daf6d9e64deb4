"""MF4 bus logs (ASAM MDF 4), through asammdf, which is an extra: pip install rtid[mf4]."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources.errors import LogError


def read(path: Path) -> Frames:
    """All classic data frames of a bus-logging MF4, sorted by time; LogError if it holds none."""
    try:
        from asammdf import MDF  # noqa: PLC0415  680 ms and 100 MB: only who reads MF4 pays
    except ImportError:
        raise LogError(f"{path}: reading MF4 needs asammdf; pip install 'rtid[mf4]'") from None
    try:
        with MDF(path) as mdf:
            start_us = round(mdf.start_time.timestamp() * 1e6)
            parts = [_group(mdf, k, start_us) for k in range(len(mdf.groups))]
    except Exception as error:  # asammdf raises whatever a damaged block causes
        raise LogError(f"{path}: not a readable MF4 bus log: {error}") from error
    found = fr.by_time(fr.concatenate([part for part in parts if part is not None]))
    if len(found) == 0:
        raise LogError(f"{path}: holds no CAN data frames; is it a bus log?")
    return found


def _group(mdf: Any, k: int, start_us: int) -> Frames | None:
    """Frames of one channel group; None if it holds no data frames."""
    names = {channel.name for channel in mdf.groups[k].channels}
    if "CAN_DataFrame" not in names:
        return None
    signal = mdf.get("CAN_DataFrame", group=k)
    if not len(signal.timestamps):
        return None
    samples = signal.samples
    length = np.asarray(samples["CAN_DataFrame.DataLength"], np.int64)
    keep = length <= fr.MAX_LENGTH
    out = fr.empty(int(keep.sum()))
    out.t_us[:] = start_us + np.rint(signal.timestamps[keep] * 1e6).astype(np.int64)
    out.channel[:] = samples["CAN_DataFrame.BusChannel"][keep]
    extended = samples["CAN_DataFrame.IDE"][keep].astype(np.uint32) * np.uint32(fr.EXTENDED)
    identifier = samples["CAN_DataFrame.ID"][keep].astype(np.uint32) & np.uint32(0x1FFF_FFFF)
    out.can_id[:] = identifier | extended
    out.length[:] = length[keep]
    data = np.asarray(samples["CAN_DataFrame.DataBytes"])[keep][:, : fr.MAX_LENGTH]
    inside = np.arange(data.shape[1]) < out.length[:, None]
    out.data[:, : data.shape[1]] = np.where(inside, data, 0)
    fr.add_counts(out.refused, {"fd_frame": int((~keep).sum())})
    return out
