"""A simulated controller on a python-can bus: sends frames with their recorded time stamps.

Open a virtual bus with `preserve_timestamps=True`: only then does the receiver see the recorded
stamps; udp_multicast always stamps at reception.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import can

from firmware_bridge.catalog import Catalog, load
from firmware_bridge.frames import Frames
from rtid.errors import RtidError
from rtid.sim.frames import CONTROLLER_ROUTES, cycle_frames
from rtid.sim.run import Run

AS_FAST_AS_POSSIBLE = float("inf")
TEST_BUSES = ("virtual", "udp_multicast")
SEND_TIMEOUT_S = 5.0  # a full queue of a virtual bus would block the sender for ever


class SendError(RtidError):
    """The bus is not for a simulated machine, or does not take its frames."""


def run_frames(run: Run, catalog: Catalog | None = None, start_us: int = 0) -> Frames:
    """The run as the controller's messages, in cycles, stamped start_us + the sample's time."""
    columns = {name: run.samples.column(name) for name in run.samples.names}
    columns["x_ref"] = run.truth.x_ref_m
    return cycle_frames(catalog or load(), CONTROLLER_ROUTES, columns, start_us + run.samples.t_us)


def open_test_bus(interface: str, channel: str) -> can.BusABC:
    """Open a bus that no machine listens to; SendError for any other or if it cannot be opened."""
    if interface not in TEST_BUSES and not (interface == "socketcan" and "vcan" in channel):
        remedy = f"use {' or '.join(TEST_BUSES)}, or socketcan on a vcan channel"
        raise SendError(
            f"{interface} {channel}: a simulated machine must not speak here", remedy, 2
        )
    options: dict[str, Any] = {"preserve_timestamps": True} if interface == "virtual" else {}
    try:
        return can.Bus(channel, interface=interface, **options)
    except (can.CanError, OSError, ValueError) as error:
        raise SendError(f"{interface} {channel}: {error}", "check the channel") from error


def send(
    bus: can.BusABC,
    messages: Iterable[can.Message],
    speed: float = 1.0,
    *,
    clock_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Send all messages at `speed` times their recorded pace (inf: at once); the number sent.

    Raises SendError if the bus takes no more frames for 5 s.
    """
    if not speed > 0:
        raise SendError(f"speed {speed:g}: must be > 0", "give inf for as fast as possible", 2)
    if speed != AS_FAST_AS_POSSIBLE:
        messages = _paced(messages, speed, clock_s, sleep)
    sent = 0
    for message in messages:
        try:
            bus.send(message, timeout=SEND_TIMEOUT_S)
        except can.CanError as error:
            raise SendError(f"after {sent} frames: {error}", "is a receiver stalled?") from error
        sent += 1
    return sent


def _paced(
    messages: Iterable[can.Message],
    speed: float,
    clock_s: Callable[[], float],
    sleep: Callable[[float], None],
) -> Iterator[can.Message]:
    """Hold back each message until its time; late ones follow at once."""
    start_s, first_s = clock_s(), None
    for message in messages:
        first_s = message.timestamp if first_s is None else first_s
        wait_s = (message.timestamp - first_s) / speed - (clock_s() - start_s)
        if wait_s > 0:
            sleep(wait_s)
        yield message
