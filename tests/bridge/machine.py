"""A simulated controller for the tests: one second and more of our own frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import catalog, encode
from firmware_bridge import frames as fr
from firmware_bridge.catalog import Catalog
from firmware_bridge.config import Assembly, SignalSource
from firmware_bridge.frames import Frames

SHARED = Path(__file__).parents[2].parent / "shared"
CATALOG: Catalog = catalog.load()
START_US = 1_700_000_000_000_000
MESSAGES = ("ValveCommand", "Pressures", "Motion")
SIGNALS = (
    SignalSource("u_v", "ValveCommand", "U", hold="zero"),
    SignalSource("p_a_pa", "Pressures", "PA"),
    SignalSource("p_b_pa", "Pressures", "PB"),
    SignalSource("p_s_pa", "Pressures", "PSupply"),
    SignalSource("p_t_pa", "ValveCommand", "PTank"),
    SignalSource("x_m", "Motion", "X"),
    SignalSource("v_mps", "Motion", "V"),
)


def cycles(n: int, seed: int = 0) -> Frames:
    """3 n frames of n cycles of 1 ms, with up to 200 us of jitter, sorted by time."""
    rng = np.random.default_rng(seed)
    t_us = START_US + 1000 * np.arange(n)
    seconds = 1e-3 * np.arange(n)
    parts = [
        encode.encode_message(
            CATALOG,
            "ValveCommand",
            t_us + rng.integers(0, 200, n),
            {"U": 9 * np.sin(7 * seconds), "XRef": 0.2, "PTank": rng.normal(1e5, 1e3, n)},
        ),
        encode.encode_message(
            CATALOG,
            "Pressures",
            t_us + rng.integers(200, 400, n),
            {name: rng.normal(3e6, 5e3, n) for name in ("PA", "PB", "PSupply")},
        ),
        encode.encode_message(
            CATALOG,
            "Motion",
            t_us + rng.integers(400, 600, n),
            {"X": 0.25 + 0.1 * np.sin(seconds), "V": 0.1 * np.cos(seconds), "Mode": 2},
        ),
    ]
    return fr.by_time(fr.concatenate(parts))


def assembly(mode: str = "cycle", counted: bool = True, protected: bool = True) -> Assembly:
    """Assembly of our own three messages."""
    from dataclasses import replace

    messages = [CATALOG.message_source(name) for name in MESSAGES]
    if not counted:
        messages = [replace(message, counter=None) for message in messages]
    if not protected:
        messages = [replace(message, crc=None) for message in messages]
    return Assembly(mode, SIGNALS, tuple(messages), "x_m")


def equal(a: Frames, b: Frames) -> bool:
    """Whether two batches hold the same frames."""
    fields = ("t_us", "channel", "can_id", "length", "data")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in fields)


def without(frames: Frames, indices: NDArray[np.intp] | list[int]) -> Frames:
    """The frames but those at `indices`."""
    keep = np.ones(len(frames), np.bool_)
    keep[indices] = False
    return frames[keep]
