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
import pytest
from numpy.typing import NDArray

from rtid.estimator.sums import Normal
from rtid.mcu.c_tables import sizes_of
from rtid.mcu.memory import COUNTS, Layout
from rtid.mcu.write import write_sources
from rtid.model import Machine
from tests.mcu.compiled import STRICT
from tests.mcu.machine import Record

HERE = Path(__file__).parent / "target"
GCC, QEMU = "arm-none-eabi-gcc", "qemu-system-arm"
PER_COUNT = 40  # instructions
M4 = ("mps2-an386", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16"))
M7 = ("mps2-an500", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16"))
FLAGS = ("-mthumb", "-mfloat-abi=hard", "-O2", *STRICT)


@dataclass(frozen=True)
class Ticks:
    """What a board did with a record: instructions of each update (n,), settled sums, counts."""

    instructions: NDArray[np.int64]
    normal: Normal
    solution: np.void
    counts: dict[str, int]


class Board:
    """The estimator of a machine, built for a board: `single` for the M4, double for the M7."""

    def __init__(
        self, model: Machine, folder: Path, blocks: int, single: bool, extra: tuple[str, ...] = ()
    ) -> None:
        for name in (GCC, QEMU):
            if shutil.which(name) is None:
                pytest.skip(f"no {name} on this machine: the controller is not emulated")
        self.layout = Layout(sizes_of(model, blocks), single)
        self.folder, (self.board, cpu) = folder, M4 if single else M7
        write_sources(folder / "estimator", model, blocks)
        sources = [*HERE.glob("*.c"), *(folder / "estimator").glob("*.c")]
        flags = [*FLAGS, *cpu, *(["-DRTID_ESTIMATOR_FLOAT32"] if single else []), *extra]
        places = [
            f"-I{folder / 'estimator'}",
            f"-I{HERE}",
            "-nostartfiles",
            f"-T{HERE / 'board.ld'}",
        ]
        command = [GCC, *flags, *places, *map(str, sources), "-o", str(folder / "board.elf")]
        subprocess.run([*command, "-nostartfiles", "--specs=nosys.specs", "-lm"], check=True)

    def run(self, record: Record) -> Ticks:
        """A record through the board; it must end well."""
        out = np.zeros(len(record.t_us), self.layout.sample)
        out["t_us"], out["values"] = record.t_us, record.values
        flags = record.flags.astype(int)
        out["row"], out["gap"] = flags & 1, (flags >> 1) & 1
        out.tofile(self.folder / "samples.bin")
        command = [QEMU, "-M", self.board, "-nographic", "-icount", "shift=0"]
        command += ["-semihosting-config", "enable=on,target=native", "-kernel", "board.elf"]
        subprocess.run(command, cwd=self.folder, check=True, timeout=300, stdin=subprocess.DEVNULL)
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
