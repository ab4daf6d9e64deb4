"""Frames of our own DBC from signals: what a simulated controller sends, in bulk."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from firmware_bridge import e2e, frames
from firmware_bridge.catalog import Catalog
from firmware_bridge.frames import Frames


def encode_message(
    catalog: Catalog,
    message: str,
    t_us: NDArray[np.int64],
    values: Mapping[str, ArrayLike],
    counter: ArrayLike = 0,
    channel: int = 0,
) -> Frames:
    """n frames of one message with alive counter and CRC.

    t_us: int64 (n,); values: per signal (n,) or a scalar, physical units of the DBC, saturating;
    a signal that is missing or NaN is sent as not available; counter: of every frame (n,), or of
    the first, taken modulo its range.
    """
    source = catalog.message_source(message)
    layouts = catalog.layouts(message)
    n = len(t_us)
    columns = np.full((n, len(layouts.names)), np.nan)
    for name, value in values.items():
        catalog.signal(message, name)  # names the nearest signal if there is no such
        columns[:, layouts.names.index(name)] = value
    if source.counter is not None:
        k = layouts.names.index(source.counter)
        counts = np.asarray(counter) + (np.arange(n) if np.ndim(counter) == 0 else 0)
        columns[:, k] = counts % (1 << int(layouts.rows["length"][k]))
    if source.crc is not None:
        columns[:, layouts.names.index(source.crc)] = 0
    out = frames.empty(n)
    out.t_us[:] = t_us
    out.channel[:] = channel
    out.can_id[:] = catalog.can_id(message)
    out.length[:] = catalog.message(message).length
    out.data[:] = layouts.encode(columns)
    if source.crc is not None:
        byte = catalog.byte_of(message, source.crc)
        length = catalog.message(message).length
        out.data[:, byte] = e2e.crc8_bulk(out.data, length, byte, source.data_id)
    return out
