"""Replay of a log and latency on a bus: from frame to updated estimate, bridge included."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter, sleep
from typing import Any

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.frames import assembler, frames
from benchmarks.interleave import Job, interleave, report
from benchmarks.machine import COARSE, SECONDS, chunk, empty, model
from firmware_bridge.frames import from_messages, to_messages
from firmware_bridge.sources import open_log
from rtid.estimator.solution import solve
from rtid.sim.run_files import write_log

PER_CYCLE = 3  # frames
ALL, ASKED = "log to samples to estimate to all maps", "1500 x real time"
CYCLES = 6000


@pytest.mark.parametrize("suffix", [".blf", ".log"])
def test_replay(benchmark: Any, tmp_path: Path, suffix: str) -> None:
    log, machine = tmp_path / f"trace{suffix}", model(COARSE)
    write_log(log, frames())
    read = open_log(log)
    data = chunk(assembler().push(read))

    def whole() -> None:
        state = empty(machine)
        state.advance(chunk(assembler().push(open_log(log))))
        solve(machine, state)

    jobs = [
        Job("read the log", lambda: open_log(log)),
        Job("frames to samples", lambda: assembler().push(read)),
        Job("estimate", lambda: empty(machine).advance(data)),
        Job(ALL, whole),
    ]
    times = benchmark.pedantic(interleave, args=(jobs, 7), rounds=1)
    rows = []
    for name, seconds in times.items():
        typical = float(np.median(seconds))
        asked = {"asked": ASKED} if name == ALL else {}
        rows.append({"name": name, "text": f"{SECONDS / typical:.0f} x real time"} | asked)
    size = f"{len(read)} frames, 10 x 8 blocks per edge"
    title = f"Replay of {SECONDS:.0f} s at 1 kHz ({size}) from {suffix}, warm"
    report(benchmark, title, "trace", rows)


@pytest.fixture
def buses() -> Iterator[tuple[can.BusABC, can.BusABC]]:
    """Return the two ends of a virtual bus, sender and receiver."""
    with (
        can.Bus("latency", interface="virtual", preserve_timestamps=True) as sender,
        can.Bus("latency", interface="virtual") as receiver,
    ):
        yield sender, receiver


def test_latency(benchmark: Any, buses: tuple[can.BusABC, can.BusABC]) -> None:
    """From the moment before the last frame of a cycle is sent to the updated estimate."""
    sender, receiver = buses
    messages = list(to_messages(frames()[: PER_CYCLE * CYCLES]))
    sent_s, done_s = np.empty(CYCLES), np.empty(CYCLES)

    def send_all() -> None:
        for k in range(CYCLES):
            sleep(1e-3)
            for message in messages[PER_CYCLE * k : PER_CYCLE * (k + 1)]:
                sent_s[k] = perf_counter()
                sender.send(message)

    def receive_all() -> None:
        bridge, state, taken = assembler(), empty(model()), 0
        state.advance(chunk(bridge.push(frames()[: PER_CYCLE * 10])))  # compiled before the bus
        bridge.reset()
        thread = threading.Thread(target=send_all)
        thread.start()
        while taken < CYCLES:
            message = receiver.recv(timeout=5.0)
            assert message is not None, f"nothing received for 5 s after {taken} samples"
            samples = bridge.push(from_messages([message]))
            if len(samples):
                state.advance(chunk(samples))
                done_s[taken : taken + len(samples)] = perf_counter()
                taken += len(samples)
        thread.join()

    benchmark.pedantic(receive_all, rounds=1)
    report(benchmark, "Latency, frame on the virtual bus to updated estimate", "cycle",
           percentiles(done_s - sent_s))  # fmt: skip


def percentiles(seconds: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Rows for the table."""
    named = (("p50", 50.0), ("p99", 99.0), ("p99.9", 99.9))
    return [{"name": name, "seconds": float(np.percentile(seconds, q))} for name, q in named]
