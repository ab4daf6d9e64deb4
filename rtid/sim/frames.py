"""Signals as CAN frames, as a controller would send them: with alive counter and CRC, if any.

Two ways to send: in cycles (all messages back to back once per row of a table), or multirate (each
message from a task of its own: own rate, own phase, own constant age, jitter as on a real vehicle).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_bridge.catalog import Catalog
from firmware_bridge.encode import encode_message
from firmware_bridge.frames import Frames, by_time, concatenate
from rtid.plain import FloatArray, IntArray

FRAME_US = 130  # 8 data bytes at 1 Mbit/s with stuff bits
ARBITRATION_US = 200  # longest wait for the bus
# A 50 ms message of a real vehicle arrives 47.1 to 53.0 ms apart (1 to 99 %): with independent
# delays of its task their standard deviation is 5.9 / (2 * 2.326 * sqrt(2)) ms, 1.8 % of 50 ms.
TASK_JITTER = 5.9 / (2 * 2.326 * np.sqrt(2)) / 50.0


@dataclass(frozen=True)
class Route:
    """Where a column goes: physical value of the DBC's signal = factor * column.

    held: the column acts until its next row (a command) and is not interpolated.
    """

    message: str
    signal: str
    factor: float = 1.0
    held: bool = False


CONTROLLER_ROUTES = {
    "u": Route("ValveCommand", "U", held=True),
    "x_ref": Route("ValveCommand", "XRef"),
    "p_tank": Route("ValveCommand", "PTank"),
    "p_a": Route("Pressures", "PA"),
    "p_b": Route("Pressures", "PB"),
    "p_supply": Route("Pressures", "PSupply"),
    "x": Route("Motion", "X"),
    "v": Route("Motion", "V"),
}
VALVE_ROUTES = {  # where each valve has a command of its own
    "u_pa": Route("ValveCommands5", "USupplyA", held=True),
    "u_at": Route("ValveCommands5", "UTankA", held=True),
    "u_pb": Route("ValveCommands5", "USupplyB", held=True),
    "u_bt": Route("ValveCommands5", "UTankB", held=True),
    "u_ab": Route("ValveCommands5", "UCross", held=True),
} | {name: route for name, route in CONTROLLER_ROUTES.items() if name != "u"}


def messages_of(routes: Mapping[str, Route]) -> tuple[str, ...]:
    """The messages that carry the routed columns, each once, in the order of the routes."""
    return tuple(dict.fromkeys(route.message for route in routes.values()))


def cycle_frames(
    catalog: Catalog,
    routes: Mapping[str, Route],
    columns: Mapping[str, FloatArray],
    t_us: IntArray,
    rng: np.random.Generator | None = None,
    jitter_us: float = 20.0,
) -> Frames:
    """All messages once per row, stamped t_us (n,) alike, in the order of the routes.

    With an rng they follow each other on the bus: one frame's time apart, each delayed by an
    exponential wait of mean jitter_us, at most half a frame's time.
    """
    counter = np.arange(len(t_us), dtype=np.int64)
    parts = []
    for place, message in enumerate(messages_of(routes)):
        stamps = t_us
        if rng is not None:
            wait_us = np.minimum(rng.exponential(jitter_us, len(t_us)), FRAME_US / 2)
            stamps = t_us + np.rint(place * FRAME_US + wait_us).astype(np.int64)
        parts.append(message_frames(catalog, message, stamps, routes, columns, counter))
    return by_time(concatenate(parts))


@dataclass(frozen=True)
class Task:
    """The task that sends one message: its rate, and the age of the values at the time stamp."""

    rate_hz: float
    offset_s: float


def multirate_frames(
    catalog: Catalog,
    routes: Mapping[str, Route],
    columns: Mapping[str, FloatArray],
    t_us: IntArray,
    tasks: Mapping[str, Task],
    rng: np.random.Generator,
    jitter: float = TASK_JITTER,
) -> Frames:
    """Each message of `tasks` at its own rate, from rows at t_us (n,).

    A task runs at phase + k / rate with a normal deviation (standard deviation jitter / rate, at
    most 3 of them), reads the columns at that instant (held, or interpolated linearly), and the
    frame is stamped with it + offset_s + a wait for the bus of 0..0.2 ms.
    """
    parts = []
    for message, task in tasks.items():
        instants_us = _task_instants_us(t_us[0], t_us[-1], 1e6 / task.rate_hz, jitter, rng)
        mine = {name: route for name, route in routes.items() if route.message == message}
        sampled = {n: _sample(columns[n], t_us, instants_us, r.held) for n, r in mine.items()}
        delay_us = 1e6 * task.offset_s + rng.uniform(0, ARBITRATION_US, len(instants_us))
        stamps = np.rint(instants_us + delay_us).astype(np.int64)
        counter = np.arange(len(stamps), dtype=np.int64)
        parts.append(message_frames(catalog, message, stamps, mine, sampled, counter))
    return by_time(concatenate(parts))


def message_frames(
    catalog: Catalog,
    message: str,
    t_us: IntArray,
    routes: Mapping[str, Route],
    columns: Mapping[str, FloatArray],
    counter: IntArray,
) -> Frames:
    """n frames of one message at t_us (n,); signals without a route are zero."""
    values: dict[str, Any] = dict.fromkeys((s.name for s in catalog.message(message).signals), 0.0)
    mine = {name: route for name, route in routes.items() if route.message == message}
    values |= {route.signal: route.factor * columns[name] for name, route in mine.items()}
    return encode_message(catalog, message, t_us, values, counter)


def _task_instants_us(
    first_us: int, last_us: int, period_us: float, jitter: float, rng: np.random.Generator
) -> FloatArray:
    """Instants of a task within [first_us, last_us], float64 microseconds, increasing."""
    phase_us = rng.uniform(0, period_us)
    nominal = np.arange(first_us + phase_us, last_us, period_us)
    spread = np.clip(rng.standard_normal(len(nominal)), -3, 3) * jitter * period_us
    return np.clip(nominal + spread, first_us, last_us)


def _sample(column: FloatArray, t_us: IntArray, at_us: FloatArray, is_held: bool) -> FloatArray:
    """The column at the instants at_us, as held or interpolated linearly."""
    if not is_held:
        return np.interp(at_us, t_us, column)
    row = np.searchsorted(t_us, at_us, side="right") - 1
    return np.asarray(column[np.maximum(row, 0)])
