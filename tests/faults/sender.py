"""Frames of a trace over udp_multicast, from a process of its own: `python -m tests.faults.sender`.

Arguments: TRACE GROUP SECONDS SPEED LOOPS FLOOD_HZ.  Datagrams are those of python-can, made
beforehand, and given a later stamp in each loop; the next loop comes a second later.  FLOOD_HZ
frames per second of other identifiers come with them.  Prints the number of the trace's frames that
were sent.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
from pathlib import Path

import msgpack

from firmware_bridge.frames import Frames
from firmware_bridge.sources import open_log
from firmware_bridge.sources.udp import PORT

PAUSE_S = 1.0  # between two loops: the machine does not jump back to its start
PIECE_S = 0.002  # what is due is sent so often
STAMP = struct.Struct(">d")
STAMP_AT = 12  # bytes of a datagram that come before: a map's head, its first key, a float's head


def datagrams(frames: Frames) -> list[bytes]:
    """What python-can would send."""
    fixed = {
        "is_extended_id": False, "is_remote_frame": False, "is_error_frame": False,
        "channel": 0, "is_fd": False, "bitrate_switch": False, "error_state_indicator": False,
    }  # fmt: skip
    rows = zip(
        frames.t_us.tolist(), frames.can_id.tolist(), frames.length.tolist(), frames.data,
        strict=True,
    )  # fmt: skip
    return [
        msgpack.packb(
            {
                "timestamp": t_us * 1e-6,
                "arbitration_id": can_id,
                "dlc": length,
                "data": data[:length].tobytes(),
            }
            | fixed
        )
        for t_us, can_id, length, data in rows
    ]


def later(datagram: bytes, shift_s: float) -> bytes:
    """The same frame, so much later."""
    (t_s,) = STAMP.unpack_from(datagram, STAMP_AT)
    return datagram[:STAMP_AT] + STAMP.pack(t_s + shift_s) + datagram[STAMP_AT + STAMP.size :]


def _foreign(frames: Frames) -> Frames:
    """The same frames under identifiers that nobody wants."""
    frames.can_id[:] = 0x400 + frames.can_id % 0x100
    return frames


def main() -> None:
    """Send."""
    trace, group, seconds, speed, loops, flood_hz = sys.argv[1:7]
    frames = open_log(Path(trace))
    at_s = (frames.t_us - frames.t_us[0]) * 1e-6
    frames, at_s = frames[at_s < float(seconds)], at_s[at_s < float(seconds)]
    made = datagrams(frames)
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)  # on this machine only
    foreign, flooded = datagrams(_foreign(frames[:100])), 0
    start_s, sent = time.monotonic(), 0
    for k in range(int(loops)):
        n, shift_s = 0, k * (float(seconds) + PAUSE_S)
        while n < len(made):
            now_s = (time.monotonic() - start_s) * float(speed) - shift_s
            while n < len(made) and at_s[n] <= now_s:
                out.sendto(later(made[n], shift_s), (group, PORT))
                n += 1
            while flooded < float(flood_hz) * (time.monotonic() - start_s):
                out.sendto(foreign[flooded % len(foreign)], (group, PORT))
                flooded += 1
            time.sleep(PIECE_S)
        sent += n
    print(sent)


if __name__ == "__main__":
    main()
