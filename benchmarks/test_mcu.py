"""The controller's estimator in C beside rtid's own kernel, the same samples of one chamber."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.compiler import SOURCES, pointer
from benchmarks.interleave import Job, ratio, report, side_by_side
from benchmarks.machine import COARSE, chunk, model, record, warmed
from benchmarks.test_update import one_by_one
from rtid.estimator.solution import solve
from rtid.mcu.c_tables import sizes_of
from rtid.mcu.memory import Layout
from rtid.mcu.valve import one_valve
from rtid.mcu.write import write_sources
from rtid.model import Machine

BLOCKS = 48
KERNEL, BY_SAMPLE = "rtid, over arrays", "rtid, State.advance per sample"
NATIVE = ("-O3", "-march=native")
DOUBLE, SINGLE = "C, float64, -O2", "C, float32, -O2"
DOUBLE_NATIVE, SINGLE_NATIVE = "C, float64, -O3 -march=native", "C, float32, -O3 -march=native"
FEW = 3000


class Controller:
    """The estimator in C with its memory, on the samples of the record."""

    def __init__(self, machine: Machine, single: bool = False, *options: str) -> None:
        gcc = shutil.which("gcc")
        if gcc is None:
            pytest.skip("no gcc on this machine: the controller's estimator is not measured")
        folder, layout = (
            Path(mkdtemp(prefix="rtid-mcu-")),
            Layout(sizes_of(machine, BLOCKS), single),
        )
        write_sources(folder, machine, BLOCKS)
        flags = ["-std=c99", "-shared", "-fPIC", f"-I{folder}", *(options or ("-O2",))]
        flags += ["-DRTID_ESTIMATOR_FLOAT32"] if single else []
        sources = [str(SOURCES / "mcu.c"), *map(str, sorted(folder.glob("*.c")))]
        subprocess.run([gcc, *flags, *sources, "-o", str(folder / "mcu.so"), "-lm"], check=True)
        self.library = ctypes.CDLL(str(folder / "mcu.so"))
        shutil.rmtree(folder)
        self.memory = np.zeros(1, layout.estimator)
        self.work, self.solution = np.zeros(1, layout.work), np.zeros(1, layout.solution)
        self.samples = self._samples(machine, layout)
        self.library.begin(pointer(self.memory))

    @staticmethod
    def _samples(machine: Machine, layout: Layout) -> NDArray[np.void]:
        taken = record()
        out = np.zeros(len(taken), layout.sample)
        out["t_us"], out["row"] = taken.t_us - taken.t_us[0], taken.flags & 1
        columns = [taken.names.index(signal.name) for signal in machine.signals]
        out["values"] = taken.values[:, columns]
        return out

    def run(self) -> None:
        """All samples; the clock's step back between two runs begins anew."""
        self.library.run(pointer(self.memory), pointer(self.samples), self._count)

    def ticks(self) -> NDArray[np.float64]:
        """Seconds of each update, the clock's own time included."""
        out = np.zeros(len(self.samples))
        at = pointer(self.memory), pointer(self.samples), self._count
        self.library.run_timed(*at, pointer(out))
        return out

    def solve(self) -> None:
        """Freeze and solve."""
        self.library.solve(pointer(self.memory), pointer(self.work), pointer(self.solution))

    @property
    def _count(self) -> ctypes.c_int64:
        return ctypes.c_int64(len(self.samples))


def valve() -> Machine:
    """Chamber A of the benchmarks' machine with its two edges, 10 x 8 blocks each."""
    return one_valve(model(COARSE), "a")


def valve_chunk(machine: Machine) -> NDArray[np.float64]:
    """The record as the kernel takes it, the signals of one chamber."""
    whole, names = chunk(record()), record().names
    columns = [2 + names.index(signal.name) for signal in machine.signals]
    return np.ascontiguousarray(whole[:, [0, 1, *columns]])


def test_update(benchmark: Any) -> None:
    machine = valve()
    data = valve_chunk(machine)
    state, by_sample = warmed(machine, data), warmed(machine, data)
    rows = [data[k : k + 1] for k in range(FEW)]
    built = {
        DOUBLE: Controller(machine),
        SINGLE: Controller(machine, True),
        DOUBLE_NATIVE: Controller(machine, False, *NATIVE),
        SINGLE_NATIVE: Controller(machine, True, *NATIVE),
    }
    jobs = [Job(name, c.run, len(data)) for name, c in built.items()]
    jobs += [
        Job(KERNEL, lambda: state.advance(data), len(data)),
        Job(BY_SAMPLE, partial(one_by_one, by_sample.advance, rows), FEW),
    ]
    title = "The controller's estimator, one chamber, two edges, 10 x 8 blocks per edge"
    times = side_by_side(benchmark, title, "sample", jobs, KERNEL)
    # both compiled for this processor, as the kernel is; -O2 for any x86-64 is reported
    assert max(ratio(times, name, KERNEL) for name in (DOUBLE_NATIVE, SINGLE_NATIVE)) <= 1.0


def test_longest_update(benchmark: Any) -> None:
    """A tick is longest where the sums of all blocks that ring are settled."""
    built = {DOUBLE: Controller(valve()), SINGLE: Controller(valve(), True)}
    result = benchmark.pedantic(
        lambda: {name: np.min([c.ticks() for _ in range(7)], axis=0) for name, c in built.items()},
        rounds=1,
    )
    rows = [
        {"name": f"{name}, {what}", "seconds": float(np.percentile(ticks, share))}
        for name, ticks in result.items()
        for what, share in (("p50", 50), ("p99.9", 99.9), ("longest", 100))
    ]
    title = "The same, each update by itself (shortest of seven runs of the record)"
    report(benchmark, title, "sample", rows)


def test_solve(benchmark: Any) -> None:
    machine = valve()
    state, built = warmed(machine, valve_chunk(machine)), Controller(machine)
    built.run()
    blocks = int(state.engine[0]["n_slots"])
    jobs = [Job("C, float64, -O2", built.solve), Job("rtid", lambda: solve(machine, state))]
    title = f"Sums of {blocks} blocks frozen and solved, covariances and statuses included"
    side_by_side(benchmark, title, "solve", jobs, "rtid")
