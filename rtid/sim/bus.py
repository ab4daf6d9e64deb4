"""A simulated controller on a python-can bus: its frames, and a bus that no machine listens to."""

from __future__ import annotations

from typing import Any

import can
import numpy as np

from firmware_bridge.catalog import Catalog, load
from firmware_bridge.frames import Frames
from firmware_bridge.playback import SendError
from rtid.plain import FloatArray
from rtid.sim.demand import DT_S
from rtid.sim.frames import CONTROLLER_ROUTES, VALVE_ROUTES, cycle_frames
from rtid.sim.robust import Tracked
from rtid.sim.run import Run
from rtid.sim.sensing import NAMES
from rtid.sim.simulated_plant import EDGES

TEST_BUSES = ("virtual", "udp_multicast")


def run_frames(run: Run, catalog: Catalog | None = None, start_us: int = 0) -> Frames:
    """The run as the controller's messages, in cycles, stamped start_us + the sample's time."""
    columns = {name: run.samples.column(name) for name in run.samples.names}
    columns["x_ref"] = run.truth.x_ref_m
    return cycle_frames(catalog or load(), CONTROLLER_ROUTES, columns, start_us + run.samples.t_us)


def tracked_frames(tracked: Tracked, reference: FloatArray, start_us: int = 0) -> Frames:
    """The messages of a controller that commands each valve by itself; reference (n, 4)."""
    columns = dict(zip(NAMES[1:], tracked.signals.T[1:], strict=True))
    columns |= {f"u_{edge}": tracked.commands_v[:, i] for i, edge in enumerate(EDGES)}
    columns["x_ref"] = reference[:, 0]
    t_us = start_us + round(1e6 * DT_S) * np.arange(len(reference), dtype=np.int64)
    return cycle_frames(load(), VALVE_ROUTES, columns, t_us)


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
