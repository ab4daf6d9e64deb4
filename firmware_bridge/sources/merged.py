"""Channels that were measured at their own instants, as one table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.table import Table, named_columns


class Channel(NamedTuple):
    """Values float64 (n,) at t_s float64 (n,), growing; unit "" if unknown."""

    title: str
    unit: str
    t_s: NDArray[np.float64]
    values: NDArray[np.float64]


def merged(path: Path, channels: Sequence[Channel]) -> Table:
    """All channels at the instants of the one that has most of them, the time as `t`.

    The others are interpolated; before their first and behind their last value they are missing.
    LogError if there is no channel.
    """
    if not channels:
        raise LogError(f"{path}: holds no channel of numbers")
    base = max((channel.t_s for channel in channels), key=len)
    columns = [(c.title, _at(base, c), c.unit) for c in channels]
    return named_columns(path, [("t", base, "s"), *columns])


def _at(base: NDArray[np.float64], channel: Channel) -> NDArray[np.float64]:
    if len(channel.t_s) == len(base) and np.array_equal(channel.t_s, base):
        return channel.values
    known = np.isfinite(channel.values)
    if not known.any():
        return np.full(len(base), np.nan)
    t_s, values = channel.t_s[known], channel.values[known]
    return np.interp(base, t_s, values, left=np.nan, right=np.nan)
