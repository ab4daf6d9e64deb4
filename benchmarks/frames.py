"""The benchmark's record as CAN frames of the controller, and what turns them back into samples."""

from __future__ import annotations

from functools import cache

from benchmarks.machine import run
from firmware_bridge.assemble import Assembler
from firmware_bridge.catalog import Catalog, load
from firmware_bridge.config import CYCLE, Assembly, SignalSource
from firmware_bridge.frames import Frames
from rtid.sim.bus import run_frames
from rtid.sim.frames import CONTROLLER_ROUTES, messages_of


@cache
def catalog() -> Catalog:
    """Return the controller's DBC."""
    return load()


@cache
def frames() -> Frames:
    """Three messages per 1 ms cycle."""
    return run_frames(run(), catalog())


def assembler() -> Assembler:
    """From the controller's frames to samples as the model's signals want them."""
    routes = {name: CONTROLLER_ROUTES[name] for name in run().samples.names}
    signals = tuple(
        SignalSource(name, route.message, route.signal, hold="zero" if route.held else "linear")
        for name, route in routes.items()
    )
    messages = tuple(catalog().message_source(message) for message in messages_of(routes))
    return Assembler(catalog(), Assembly(CYCLE, signals, messages, row_signal="x"))
