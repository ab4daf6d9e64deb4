"""Frames into a log file through python-can's writers, microseconds kept exactly.

A BLF file holds its start with milliseconds and only if it lies after 1990: stamps start at a round
date, so that BLF and candump tell the same absolute time.
"""

from __future__ import annotations

from pathlib import Path

import can

from firmware_bridge.frames import Frames, to_messages

START_US = 1_600_000_000_000_000
SUFFIXES = (".blf", ".log", ".asc")


def write_log(path: Path, frames: Frames) -> None:
    """Write all frames; the suffix names the format.  Raises ValueError for an unknown one."""
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{path}: unknown kind of log; use one of {', '.join(SUFFIXES)}")
    with can.Logger(path) as log:
        for message in to_messages(frames):
            log.on_message_received(message)
