"""Live frames from any bus that python-can knows: virtual, udp_multicast, socketcan, ..."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import can

from firmware_bridge import frames as fr
from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.sources.live import POLL_S, LiveSource, SourceError
from firmware_bridge.sources.sockets import enlarge_buffer
from firmware_bridge.steps import Continuous


class CanBus(LiveSource[can.Message]):
    """Frames of one bus, listening only.

    `can_ids` (as in `Frames.can_id`) are filtered by the driver where it can; None takes all.
    Time stamps are python-can's, but a clock that is set back does not stop them (see `steps`).
    Raises SourceError if the bus cannot be opened.
    """

    def __init__(
        self,
        interface: str,
        channel: str | int | None = None,
        can_ids: Iterable[int] | None = None,
        reopen_s: float = 0.0,
        **options: Any,
    ) -> None:
        super().__init__(reopen_s=reopen_s)
        self._name = f"{interface} channel {channel!r}"
        filters = None if can_ids is None else [_filter(can_id) for can_id in can_ids]
        self._options = {
            "interface": interface, "channel": channel, "can_filters": filters, **options
        }  # fmt: skip
        self._clock = Continuous()
        self._open()

    def _open(self) -> None:
        try:
            self._bus = can.Bus(**self._options)
        except Exception as error:  # each interface raises its own kind
            raise SourceError(f"cannot open {self._name}: {error}") from error
        enlarge_buffer(self._bus)

    def _receive(self) -> can.Message | None:
        return self._bus.recv(POLL_S)

    def _convert(self, items: list[can.Message]) -> Frames:
        return self._clock.push(fr.from_messages(items))

    def _close(self) -> None:
        self._bus.shutdown()


def _filter(can_id: int) -> can.typechecking.CanFilter:
    extended = bool(can_id & EXTENDED)
    mask = 0x1FFF_FFFF if extended else 0x7FF
    return {"can_id": can_id & mask, "can_mask": mask, "extended": extended}
