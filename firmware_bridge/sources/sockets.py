"""What python-can leaves as it is on the socket behind a bus, where there is a socket."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator

import can

RECEIVE_BUFFER_BYTES = 4 << 20  # the default loses thousands of frames in a stall of 2 s
OF_ALL_GROUPS = {  # of Linux, which Python does not name: the option's level and number
    socket.AF_INET: (socket.IPPROTO_IP, 49),
    socket.AF_INET6: (socket.IPPROTO_IPV6, 29),
}


def enlarge_buffer(bus: can.BusABC) -> None:
    """Ask the system for a large receive buffer; refused, the default remains."""
    with contextlib.suppress(OSError), _twin(bus) as twin:
        if twin is not None:
            twin.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)


def hear_one_group(bus: can.BusABC) -> None:
    """Let a udp_multicast bus hear its own group alone; others remain as they are.

    It binds to every address, so that Linux gives it what any group of this computer is sent.
    """
    with contextlib.suppress(OSError), _twin(bus) as twin:
        if twin is not None and (option := OF_ALL_GROUPS.get(socket.AddressFamily(twin.family))):
            twin.setsockopt(*option, 0)


@contextlib.contextmanager
def _twin(bus: can.BusABC) -> Iterator[socket.socket | None]:
    """The bus's socket under another number, closed at the end; None where there is none."""
    twin = None
    with contextlib.suppress(Exception):  # each interface raises its own kind
        number = os.dup(bus.fileno())
        try:
            twin = socket.socket(fileno=number)
        except OSError:  # a serial port's, say
            os.close(number)
    with twin or contextlib.nullcontext():
        yield twin
