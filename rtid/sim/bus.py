"""A simulated controller on a python-can bus: sends frames with their recorded time stamps.

Open a virtual bus with `preserve_timestamps=True`: only then does the receiver see the recorded
stamps; udp_multicast always stamps at reception.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import can

from firmware_bridge.catalog import Catalog, load
from firmware_bridge.frames import Frames, to_messages
from rtid.sim.frames import CONTROLLER_ROUTES, cycle_frames
from rtid.sim.run import Run

AS_FAST_AS_POSSIBLE = float("inf")
SEND_TIMEOUT_S = 5.0  # a full queue of a virtual bus would block the sender for ever


def run_frames(run: Run, catalog: Catalog | None = None) -> Frames:
    """The run as the controller's messages, in cycles; stamps are exactly the samples' times."""
    columns = {name: run.samples.column(name) for name in run.samples.names}
    columns["x_ref"] = run.truth.x_ref_m
    return cycle_frames(catalog or load(), CONTROLLER_ROUTES, columns, run.samples.t_us)


def send(
    bus: can.BusABC,
    frames: Frames,
    speed: float = 1.0,
    *,
    clock_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Send all frames at `speed` times their recorded pace (inf: at once); the number sent.

    Raises can.CanOperationError if the bus takes no more frames for 5 s.
    """
    if not speed > 0:
        raise ValueError(f"speed {speed:g}: must be > 0, or inf for as fast as possible")
    messages = to_messages(frames)
    if speed != AS_FAST_AS_POSSIBLE:
        messages = _paced(messages, speed, clock_s, sleep)
    sent = 0
    for message in messages:
        bus.send(message, timeout=SEND_TIMEOUT_S)
        sent += 1
    return sent


def _paced(
    messages: Iterator[can.Message],
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
