"""The estimator in C, compiled for this machine and run on samples."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import firmware_bridge
from rtid.estimator.state import Weights
from rtid.mcu.c_tables import sizes_of, tables
from rtid.mcu.memory import COUNTS, Layout
from rtid.model import Machine
from rtid.plain import FloatArray

HERE = Path(__file__).parent
SOURCES = Path(firmware_bridge.__file__).parent / "c"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion")
OPTIMISED = ("-O2",)
SANITISED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
COMPILER = next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)
TAKEN = -1


def files() -> list[Path]:
    """The estimator's sources."""
    return sorted(SOURCES.glob("rtid_estimator*.c"))


@dataclass(frozen=True)
class Outcome:
    """What the C made of samples: verdicts, memory after the last, settled sums, solution, maps."""

    layout: Layout
    verdicts: NDArray[np.int8]
    memory: np.void
    matrix: FloatArray
    work: np.void
    solution: np.void

    @property
    def maps(self) -> NDArray[np.void]:
        """What is known of each visited block, in the order of their first visits."""
        return np.asarray(self.work["map"][: self.work["n_slots"]])

    @property
    def counts(self) -> dict[str, int]:
        """Counters by name."""
        return dict(zip(COUNTS, self.memory["counts"].tolist(), strict=True))


class Program:
    """The estimator for one declaration, compiled as a program of its own."""

    def __init__(
        self,
        model: Machine,
        folder: Path,
        blocks: int = 0,
        single: bool = False,
        options: tuple[str, ...] = OPTIMISED,
        weights: Weights | None = None,
    ) -> None:
        if COMPILER is None:
            pytest.skip("no cc, gcc or clang on this machine: the estimator in C is not tested")
        self.model, self.layout = model, Layout(sizes_of(model, blocks), single)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "rtid_estimator_tables.h").write_text(tables(model, blocks, weights))
        self.path = folder / "estimator"
        chosen = [*options, *(["-DRTID_ESTIMATOR_FLOAT32"] if single else [])]
        sources = [str(HERE / "harness.c"), *map(str, files())]
        command = [COMPILER, *STRICT, *chosen, f"-I{folder}", f"-I{SOURCES}", *sources]
        subprocess.run([*command, "-o", str(self.path), "-lm"], check=True)

    def samples(self, t_us: NDArray[np.int64], values: FloatArray, flags: FloatArray) -> bytes:
        """Records for the harness; values (n, signals) in the model's order, flags (n,)."""
        out = np.zeros(len(t_us), self.layout.sample)
        out["t_us"], out["values"] = t_us, values
        out["row"], out["gap"] = flags.astype(int) & 1, (flags.astype(int) >> 1) & 1
        return out.tobytes()

    def run(self, samples: bytes, ask_every: int = 0) -> Outcome:
        """Feed samples, ask for a solution every so many; the program must end well."""
        command = [str(self.path), str(ask_every)]
        done = subprocess.run(command, input=samples, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr.decode()[-2000:]
        layout, n = self.layout, len(samples) // self.layout.sample.itemsize
        rest = memoryview(done.stdout)
        records = [layout.estimator, layout.work, layout.sample, layout.solution]
        sizes, rest = np.frombuffer(rest[:32], np.uint64), rest[32:]
        assert sizes.tolist() == [record.itemsize for record in records], sizes
        verdicts, rest = np.frombuffer(rest[:n], np.int8), rest[n:]
        found = []
        matrix = np.dtype((np.float64, (layout.sizes.sums,)))
        for dtype in (layout.estimator, matrix, layout.work, layout.solution):
            found.append(np.frombuffer(rest[: dtype.itemsize], dtype)[0])
            rest = rest[dtype.itemsize :]
        assert not rest
        return Outcome(layout, verdicts, *found)
