"""Frames of python-can's udp_multicast, read by our own source: a test transport between processes.

python-can stamps a frame when it is received and needs about 60 us for it; here a datagram costs a
few microseconds, and the sender's stamp is kept, as on a virtual bus with `preserve_timestamps`: so
a simulated controller has the clock of its cycles, not that of a loaded machine.  A frame without a
stamp is stamped on arrival.  Nobody is authenticated.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Iterable
from typing import Any

import numpy as np

from firmware_bridge import frames as fr
from firmware_bridge.frames import EXTENDED, MAX_LENGTH, Frames, channel_number
from firmware_bridge.sources.live import POLL_S, LiveSource, SourceError, now_us
from firmware_bridge.sources.sockets import RECEIVE_BUFFER_BYTES
from firmware_bridge.steps import Continuous

PORT = 43113  # python-can's
GROUP = "239.74.163.2"
SO_RCVBUFFORCE = 33  # beyond the system's limit, for those who may
MAX_DATAGRAM = 512

Datagram = tuple[int, bytes]


class UdpMulticast(LiveSource[Datagram]):
    """Frames of one group, listening only; `can_ids` as in `Frames.can_id`, None takes all.

    Raises SourceError if the group cannot be joined or msgpack is not installed.
    """

    def __init__(
        self,
        group: str | None = None,
        can_ids: Iterable[int] | None = None,
        reopen_s: float = 0.0,
        port: int = PORT,
    ) -> None:
        super().__init__(reopen_s=reopen_s)
        self._group, self._port = group or GROUP, port
        self._wanted = None if can_ids is None else frozenset(can_ids)
        self._clock = Continuous()
        try:
            import msgpack  # noqa: PLC0415 (an extra of python-can, for tests only)
        except ImportError as error:
            raise SourceError("udp_multicast needs msgpack: pip install msgpack") from error
        self._unpack = msgpack.unpackb
        self._open()

    def _open(self) -> None:
        try:
            self._socket = _joined(self._group, self._port)
        except OSError as error:
            raise SourceError(f"cannot join udp_multicast {self._group!r}: {error}") from error

    def _receive(self) -> Datagram | None:
        try:
            return now_us(), self._socket.recv(MAX_DATAGRAM)
        except TimeoutError:
            return None

    def _convert(self, items: list[Datagram]) -> Frames:
        kept: list[tuple[int, int, int, bytes]] = []
        refused: dict[str, int] = {}
        for arrived_us, datagram in items:
            try:
                frame = self._unpack(datagram)
                reason = self._read(frame, arrived_us, kept)
            except (ValueError, KeyError, TypeError):
                reason = "bad_datagram"
            if reason:
                refused[reason] = refused.get(reason, 0) + 1
        frames = _columns(kept)
        fr.add_counts(frames.refused, refused)
        return self._clock.push(frames)

    def _read(
        self, frame: dict[str, Any], arrived_us: int, kept: list[tuple[int, int, int, bytes]]
    ) -> str:
        """Append stamp, channel, identifier and payload to kept, or say why not."""
        can_id = frame["arbitration_id"] | (EXTENDED if frame["is_extended_id"] else 0)
        if frame["is_error_frame"]:
            return "error_frame"
        if self._wanted is not None and can_id not in self._wanted:
            return ""
        if frame["is_remote_frame"]:
            return "remote_frame"
        data = frame["data"] or b""
        if frame["is_fd"] or len(data) > MAX_LENGTH:
            return "fd_frame"
        if len(data) != frame["dlc"]:
            return "short_frame"
        stamp_us = round(frame["timestamp"] * 1e6) or arrived_us
        kept.append((stamp_us, channel_number(frame["channel"]), can_id, data))
        return ""

    def _close(self) -> None:
        self._socket.close()


def _columns(rows: list[tuple[int, int, int, bytes]]) -> Frames:
    if not rows:
        return fr.empty(0)
    stamps, channels, ids, payloads = zip(*rows, strict=True)
    data = b"".join([payload.ljust(MAX_LENGTH, b"\0") for payload in payloads])
    return Frames(
        np.array(stamps, np.int64),
        np.array(channels, np.uint8),
        np.array(ids, np.uint32),
        np.array([len(payload) for payload in payloads], np.uint8),
        np.frombuffer(bytearray(data), np.uint8).reshape(-1, MAX_LENGTH),
    )


def _joined(group: str, port: int) -> socket.socket:
    """A socket that receives the datagrams of an IPv4 or IPv6 group."""
    family, *_, address = socket.getaddrinfo(group, port, type=socket.SOCK_DGRAM)[0]
    opened = socket.socket(family, socket.SOCK_DGRAM)
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        with contextlib.suppress(OSError):
            opened.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
        opened.bind(address)
        if family == socket.AF_INET6:
            request = socket.inet_pton(family, group) + struct.pack("@I", 0)
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, request)
        else:
            request = struct.pack("4sL", socket.inet_aton(group), socket.INADDR_ANY)
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, request)
        opened.settimeout(POLL_S)
    except OSError:
        opened.close()
        raise
    return opened
