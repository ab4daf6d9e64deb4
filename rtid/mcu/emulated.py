"""The estimator in C on emulated Cortex-M boards: instructions of each tick, and its result.

QEMU with `-icount shift=0` runs one instruction per nanosecond, so the board's counter at 25 MHz
counts 40 instructions.  Instructions are not cycles: memory that waits and units that stall cost
more on a real board.
"""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.c_tables import BOARD
from rtid.estimator.sums import Normal
from rtid.mcu.c_tables import Tiles, sizes_of
from rtid.mcu.errors import ValveError
from rtid.mcu.memory import COUNTS, Layout
from rtid.mcu.write import write_sources
from rtid.model import Machine
from rtid.plain import FloatArray, IntArray

GCC, QEMU = "arm-none-eabi-gcc", "qemu-system-arm"
PER_COUNT = 40  # instructions
M4 = ("mps2-an386", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16"))
M7 = ("mps2-an500", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16"))
FLAGS = ("-mthumb", "-mfloat-abi=hard", "-O2", "-std=c99", "-Wall", "-Wextra", "-Wconversion")
LONGEST_S = 300


def absent() -> str:
    """What this machine lacks to emulate a controller; "" where nothing."""
    trial = [GCC, "-fsyntax-only", "-xc", "-include", "math.h", "/dev/null"]
    found = shutil.which(GCC)
    if not found or subprocess.run(trial, check=False, capture_output=True).returncode:
        return "gcc-arm-none-eabi with libnewlib-arm-none-eabi"
    return "" if shutil.which(QEMU) else "qemu-system-arm"


@dataclass(frozen=True)
class Record:
    """Samples of a machine: t_us (n,), values (n, signals) in its order, flags (n,)."""

    t_us: IntArray
    values: FloatArray
    flags: FloatArray

    @property
    def chunk(self) -> FloatArray:
        """Rows (n, 2 + signals) as `State.advance` takes them: s, flags, SI."""
        return np.column_stack([self.t_us * 1e-6, self.flags, self.values])


@dataclass(frozen=True)
class Ticks:
    """What a board did with a record: instructions of each update (n,), settled sums, counts."""

    instructions: NDArray[np.int64]
    normal: Normal
    solution: np.void
    counts: dict[str, int]

    @property
    def worst(self) -> int:
        """Instructions of the longest update."""
        return int(self.instructions.max())


class Board:
    """The estimator of a machine, built for a board: `single` for the M4, double for the M7.

    Raises ValveError where there is no cross compiler or no emulator.
    """

    def __init__(
        self,
        model: Machine,
        folder: Path,
        blocks: int,
        single: bool,
        tiles: Tiles | None = None,
        extra: tuple[str, ...] = (),
    ) -> None:
        if lacking := absent():
            raise ValveError(f"there is no {lacking}: no controller is emulated", "install it")
        self.layout, self.folder = Layout(sizes_of(model, blocks), single), folder
        self.board, cpu = M4 if single else M7
        folder.mkdir(parents=True, exist_ok=True)
        written = write_sources(folder / "estimator", model, blocks, tiles=tiles)
        sources = [*BOARD.glob("*.c"), *(path for path in written if path.suffix == ".c")]
        flags = [*FLAGS, *cpu, *(["-DRTID_ESTIMATOR_FLOAT32"] if single else []), *extra]
        flags += ["-fstack-usage", f"-I{folder / 'estimator'}", f"-I{BOARD}", "-nostartfiles"]
        command = [GCC, *flags, f"-T{BOARD / 'board.ld'}", *map(str, sources), "-o", "board.elf"]
        subprocess.run([*command, "--specs=nosys.specs", "-lm"], check=True, cwd=folder)

    @property
    def stack(self) -> tuple[int, int]:
        """Bytes at most in an update and in a solve: all functions of their sources together."""
        used: dict[str, int] = {}
        for path in self.folder.glob("*.su"):
            for line in path.read_text().splitlines():
                where, size, _ = line.split("\t")
                name = Path(where.split(":")[0]).stem
                used[name] = used.get(name, 0) + int(size)
        sums, solve = used["rtid_estimator_sums"], used["rtid_estimator_solve"]
        return used["rtid_estimator"] + used["rtid_estimator_interval"] + sums, solve + sums

    def run(self, record: Record) -> Ticks:
        """A record through the board; it must end well."""
        out = np.zeros(len(record.t_us), self.layout.sample)
        out["t_us"], out["values"] = record.t_us, record.values
        flags = record.flags.astype(int)
        out["row"], out["gap"] = flags & 1, (flags >> 1) & 1
        out.tofile(self.folder / "samples.bin")
        command = [QEMU, "-M", self.board, "-nographic", "-icount", "shift=0"]
        command += ["-semihosting-config", "enable=on,target=native", "-kernel", "board.elf"]
        quiet, folder = subprocess.DEVNULL, self.folder
        subprocess.run(command, cwd=folder, check=True, timeout=LONGEST_S, stdin=quiet)
        return self._read(len(out))

    def _read(self, n: int) -> Ticks:
        rest = (self.folder / "out.bin").read_bytes()
        counts, rest = np.frombuffer(rest[: 4 * n], np.uint32), rest[4 * n :]
        size = 8 * self.layout.sizes.sums
        matrix, rest = np.frombuffer(rest[:size]), rest[size:]
        size = self.layout.solution.itemsize
        solution, rest = np.frombuffer(rest[:size], self.layout.solution)[0], rest[size:]
        memory = np.frombuffer(rest, self.layout.estimator)[0]
        named = dict(zip(COUNTS, memory["counts"].tolist(), strict=True))
        normal = self.layout.normal(memory, matrix)
        return Ticks(counts.astype(np.int64) * PER_COUNT, normal, solution, named)
