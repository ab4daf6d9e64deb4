"""Several live sources as one, each with its channel number: a project with two buses."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources.live import POLL_S, LiveSource, Source


class Several(Source):
    """The frames of all sources, `Frames.channel` set to each one's key (0 to 255).

    A batch is merged by time stamp; within a channel the order of arrival stays as it is.  The
    failure of one source is the failure of all.
    """

    def __init__(self, sources: Mapping[int, LiveSource[Any]]) -> None:
        self._sources = dict(sources)
        self._arrived = threading.Condition()
        for source in self._sources.values():
            source.share(self._arrived)

    def start(self) -> Self:
        """Begin to receive on all channels."""
        for source in self._sources.values():
            source.start()
        return self

    def read(self, timeout_s: float = POLL_S) -> Frames:
        """See `Source.read`."""
        with self._arrived:
            self._arrived.wait_for(self._is_due, timeout_s)
        parts = []
        for number, source in self._sources.items():
            part = source.read(0.0)
            part.channel[:] = number
            parts.append(part)
        return _merged(parts)

    def stop(self) -> None:
        """Stop all sources; harmless when called again."""
        for source in self._sources.values():
            source.stop()

    @property
    def is_over(self) -> bool:
        """See `Source.is_over`."""
        return all(source.is_over for source in self._sources.values())

    @property
    def is_down(self) -> bool:
        """See `Source.is_down`."""
        return any(source.is_down for source in self._sources.values())

    @property
    def queued(self) -> int:
        """See `Source.queued`."""
        return sum(source.queued for source in self._sources.values())

    def _is_due(self) -> bool:
        return any(source.is_due for source in self._sources.values())


def _merged(parts: list[Frames]) -> Frames:
    """One batch in order of the latest stamp that each channel has reached."""
    every = fr.concatenate(parts)
    reached = np.concatenate([np.maximum.accumulate(part.t_us) for part in parts])
    merged = every[np.argsort(reached, kind="stable")]
    merged.refused.update(every.refused)
    return merged
