"""Playing frames onto a bus at their recorded pace: the one place of the bridge that sends.

Open a virtual bus with `preserve_timestamps=True`: only then does the receiver see the recorded
stamps; udp_multicast always stamps at reception.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator

import can

AS_FAST_AS_POSSIBLE = float("inf")
SEND_TIMEOUT_S = 5.0  # a full queue of a virtual bus would block the sender for ever


class SendError(RuntimeError):
    """The bus cannot be opened or does not take the frames; `exit_code` 2 for a wrong argument."""

    def __init__(self, message: str, exit_code: int = 3) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def send(
    bus: can.BusABC,
    messages: Iterable[can.Message],
    speed: float = 1.0,
    *,
    clock_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Send all messages at `speed` times their recorded pace (inf: at once); the number sent.

    Raises SendError for a speed that is not positive, or if the bus takes no more frames for 5 s.
    """
    if not speed > 0:
        raise SendError(f"speed {speed:g}: must be > 0, or inf for as fast as possible", 2)
    if speed != AS_FAST_AS_POSSIBLE:
        messages = _paced(messages, speed, clock_s, sleep)
    sent = 0
    for message in messages:
        try:
            bus.send(message, timeout=SEND_TIMEOUT_S)
        except can.CanError as error:
            raise SendError(f"after {sent} frames: {error}; is a receiver stalled?") from error
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
