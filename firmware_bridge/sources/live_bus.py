"""Any live source of frames by the name of its interface, as a project file has it.

"serial" (COBS frames of a controller), "slcan" and "udp_multicast" are read by our own sources,
every other interface through python-can.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import can

from firmware_bridge.frames import channel_number
from firmware_bridge.sources.can_bus import CanBus
from firmware_bridge.sources.live import LiveSource, Source, SourceError
from firmware_bridge.sources.serial_port import SerialPort
from firmware_bridge.sources.several import Several
from firmware_bridge.sources.slcan import Slcan
from firmware_bridge.sources.udp import UdpMulticast

ON_PORTS = ("serial", "slcan")
# What makes an adapter not even acknowledge; socketcan has it in `ip link ... listen-only on`.
LISTENING: dict[str, dict[str, Any]] = {
    "vector": {"listen_only": True},
    "kvaser": {"driver_mode": False},
    "pcan": {"state": can.BusState.PASSIVE},
}


def open_live(
    interface: str,
    channel: str | None = None,
    *,
    bitrate: int | None = None,
    can_ids: Iterable[int] | None = None,
    reopen_s: float = 0.0,
    **options: Any,
) -> Source:
    """Open the source; several channels, separated by commas, become one source.

    Then a frame's channel is the number at the end of its channel's name where these numbers all
    differ ("can1,can3"), else the place in the list.  `options` go to the source.  Raises
    SourceError if it cannot be opened.
    """
    names = [name.strip() for name in (channel or "").split(",")]
    ids = None if can_ids is None else list(can_ids)
    opened: list[LiveSource[Any]] = []
    try:
        for name in names:
            opened.append(_open_one(interface, name or None, bitrate, ids, reopen_s, options))
    except Exception:
        for source in opened:
            source.stop()
        raise
    if len(opened) == 1:
        return opened[0]
    return Several(dict(zip(_numbers(names), opened, strict=True)))


def _open_one(
    interface: str,
    channel: str | None,
    bitrate: int | None,
    can_ids: list[int] | None,
    reopen_s: float,
    options: dict[str, Any],
) -> LiveSource[Any]:
    if interface in ON_PORTS and channel is None:
        raise SourceError(f'interface "{interface}": name its port, channel = "/dev/ttyACM0"')
    if interface == "serial" and channel is not None:
        return SerialPort(channel, reopen_s=reopen_s, **options)
    if interface == "slcan" and channel is not None:
        return Slcan(channel, bitrate, reopen_s=reopen_s, **options)
    if interface == "udp_multicast":
        return UdpMulticast(channel, can_ids, reopen_s, **options)
    speed = {} if bitrate is None else {"bitrate": bitrate}
    options = LISTENING.get(interface, {}) | speed | options
    return CanBus(interface, channel, can_ids, reopen_s, **options)


def _numbers(names: list[str]) -> list[int]:
    """A number for each channel: that in its name, or its place if two would be the same."""
    numbers = [channel_number(name) for name in names]
    return numbers if len(set(numbers)) == len(numbers) else list(range(len(names)))
