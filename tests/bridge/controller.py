"""The controller at the other end: the firmware's C, compiled and called, and lines that lose."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from firmware_bridge import c_tables
from tests.left import shared_folder

HERE = Path(__file__).parent
SOURCES = Path(c_tables.HEADER).parent
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion")
COMPILER = next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)
FILES = ("rtid_map.c", "rtid_download.c")
SANITISE = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def compiled(name: str, *options: str) -> Path:
    """controller.c with the receiver, built with more options; skips where there is no compiler."""
    if COMPILER is None:
        pytest.skip("no cc, gcc or clang on this machine: the controller's C is not tested")
    built = shared_folder("rtid-controller-") / name
    sources = [str(HERE / "controller.c"), *(str(SOURCES / file) for file in FILES)]
    command = [COMPILER, *STRICT, *options, f"-I{SOURCES}", *sources, "-lm", "-o", str(built)]
    subprocess.run(command, check=True)
    return built


@cache
def library() -> ctypes.CDLL:
    """The receiver as a library."""
    found = ctypes.CDLL(str(compiled("controller.so", "-O2", "-shared", "-fPIC")))
    found.controller_new.restype = ctypes.c_void_p
    return found


@cache
def sanitised() -> Path:
    """The receiver as a program under ASan and UBSan."""
    return compiled("controller", "-O1", "-DPROGRAM", *SANITISE)


def _pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


class Controller:
    """One with n_slots maps and room for so many nodes and flows in each."""

    def __init__(self, n_slots: int = 6, n_nodes: int = 300, n_counts: int = 16_000) -> None:
        self._c = library()
        self._it = ctypes.c_void_p(self._c.controller_new(n_slots, n_nodes, n_counts))
        self.now_ms = 0

    def __del__(self) -> None:
        self._c.controller_free(self._it)

    def push(self, data: bytes) -> list[bytes]:
        """Its answers to one frame."""
        answers = ctypes.create_string_buffer(16)
        at = ctypes.c_uint32(self.now_ms & 0xFFFF_FFFF)
        n = self._c.controller_push(self._it, at, data, ctypes.c_uint8(len(data)), answers)
        return [answers.raw[8 * k : 8 * k + 8] for k in range(n)]

    def limit(self, command: float, dp: float, flow: float) -> None:
        """Refuse maps beyond these, V, Pa, m3/s."""
        self._c.controller_limit(self._it, *(ctypes.c_float(x) for x in (command, dp, flow)))

    def hold(self, hold: bool) -> None:
        """Refuse to change maps now."""
        self._c.controller_hold(self._it, int(hold))

    def held(self, slot: int) -> tuple[int, int] | None:
        """Version and CRC of what is active."""
        version, crc = ctypes.c_uint32(), ctypes.c_uint32()
        is_held = self._c.controller_held(self._it, slot, ctypes.byref(version), ctypes.byref(crc))
        return (version.value, crc.value) if is_held else None

    def flow(
        self, slot: int, u: ArrayLike, dp: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Q and status at points."""
        return self._evaluated(self._c.controller_flow, slot, u, dp)

    def command(
        self, slot: int, q: ArrayLike, dp: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """u and status for flows."""
        return self._evaluated(self._c.controller_command, slot, q, dp)

    def numbers(self, slot: int) -> list[float]:
        """Active numbers."""
        out = np.zeros(256, np.float32)
        return out[: self._c.controller_numbers(self._it, slot, _pointer(out))].tolist()

    @property
    def counts(self) -> tuple[int, int, int]:
        """Frames that were damaged, strange, repeated."""
        out = np.zeros(3, np.uint32)
        self._c.controller_counts(self._it, _pointer(out))
        return int(out[0]), int(out[1]), int(out[2])

    def _evaluated(
        self, function: Any, slot: int, x: ArrayLike, dp: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        a, b = (np.ascontiguousarray(y, np.float32) for y in np.broadcast_arrays(x, dp))
        out, status = np.zeros(a.shape, np.float32), np.zeros(a.shape, np.uint8)
        function(
            self._it, slot, ctypes.c_size_t(a.size),
            _pointer(a), _pointer(b), _pointer(out), _pointer(status),
        )  # fmt: skip
        return out, status


def notice(data: bytes) -> tuple[int, list[float]]:
    """A notice as the firmware reads it: its operation, and all fields of rtid_notice."""
    out = np.zeros(10, np.float32)
    op = library().controller_notice(data, ctypes.c_uint8(len(data)), _pointer(out))
    return op, out.tolist()


@dataclass
class Line:
    """A line to a controller in made-up time: what it does to frames is up to `spoil`.

    spoil(data, is_answer) gives what arrives in place of one frame: nothing, it, or several.
    """

    controller: Controller
    spoil: Callable[[bytes, bool], list[bytes]] = lambda data, is_answer: [data]
    sent: list[bytes] = field(default_factory=list)
    time_s: float = 0.0
    _answers: deque[bytes] = field(default_factory=deque)

    def tell(self, data: bytes) -> None:
        """To the controller, whose answers wait for `hear`."""
        self.sent.append(data)
        self.time_s += 250e-6
        self.controller.now_ms = round(1e3 * self.time_s)
        for arrived in self.spoil(data, False):
            for answer in self.controller.push(arrived):
                self._answers.extend(self.spoil(answer, True))

    def hear(self, timeout_s: float) -> bytes | None:
        """An answer; time passes where there is none."""
        if self._answers:
            return self._answers.popleft()
        self.time_s += timeout_s
        return None
