"""A simulated controller on a python-can bus: its frames, and a bus that no machine listens to."""

from __future__ import annotations

from typing import Any

import can

from firmware_bridge.catalog import Catalog, load
from firmware_bridge.frames import Frames
from firmware_bridge.playback import SendError
from rtid.sim.frames import CONTROLLER_ROUTES, cycle_frames
from rtid.sim.run import Run

TEST_BUSES = ("virtual", "udp_multicast")


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
            f"{interface} {channel}: a simulated machine must not speak here; {remedy}", 2
        )
    options: dict[str, Any] = {"preserve_timestamps": True} if interface == "virtual" else {}
    try:
        return can.Bus(channel, interface=interface, **options)
    except (can.CanError, OSError, ValueError) as error:
        raise SendError(f"{interface} {channel}: {error}; check the channel") from error
