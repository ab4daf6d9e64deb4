"""Decoding per frame: rtid's bulk decoder beside cantools and the struct module."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.frames import assembler, catalog, frames
from benchmarks.interleave import Job, side_by_side

MESSAGE = "Pressures"
FEW = 3000
SCALE = 152.59021896696422  # Pa per count


def payloads() -> NDArray[np.uint8]:
    every = frames()
    return np.asarray(every.data[every.can_id == catalog().can_id(MESSAGE)])


def by_cantools(raw: list[bytes]) -> list[dict[str, Any]]:
    message = catalog().message(MESSAGE)
    return [message.decode(data) for data in raw]  # type: ignore[misc]


def by_struct(raw: list[bytes]) -> list[tuple[float, ...]]:
    unpack = struct.Struct("<xxHHH").unpack
    return [tuple(SCALE * count for count in unpack(data)) for data in raw]


def test_all_decode_alike() -> None:
    raw = [data.tobytes() for data in payloads()[:FEW]]
    ours = catalog().layouts(MESSAGE).decode(payloads()[:FEW])
    names = catalog().layouts(MESSAGE).names
    oracle = np.array([[decoded[name] for name in names] for decoded in by_cantools(raw)])
    np.testing.assert_allclose(ours, oracle, rtol=1e-15)
    columns = [names.index(name) for name in ("PA", "PB", "PSupply")]
    np.testing.assert_allclose(by_struct(raw), oracle[:, columns], rtol=1e-15)


def test_decoding(benchmark: Any) -> None:
    data, layouts, every = payloads(), catalog().layouts(MESSAGE), frames()
    raw = [row.tobytes() for row in data[:FEW]]
    to_samples = assembler()

    def assemble() -> None:
        to_samples.reset()
        to_samples.push(every)

    jobs = [
        Job("rtid, bulk, all five signals", lambda: layouts.decode(data), len(data)),
        Job("rtid, decoded, checked (CRC, counter), assembled to samples", assemble, len(every)),
        Job("struct, three signals, frame by frame", lambda: by_struct(raw), FEW),
        Job("cantools, all five signals", lambda: by_cantools(raw), FEW),
    ]
    title, asked = "Decoding the frames of the controller", {jobs[-1].name: "100 x"}
    side_by_side(benchmark, title, "frame", jobs, jobs[0].name, asked=asked)
