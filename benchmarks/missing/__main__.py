"""Which physics is missing, and how good is the map?  All methods on the same records.

    python -m benchmarks.missing --seed 2026 --size middle --out out/missing

writes the records, runs every method on them, each in a process of its own, and leaves
FOLDER/SEED/result.json; `benchmarks.missing.page` makes docs/benchmark.md of it.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import platform
import subprocess
import sys
import time
from collections.abc import Iterable
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

from benchmarks.missing.collect import digest, draw_seed, path_of, results, write_order
from benchmarks.missing.methods import FILES, methods_of
from benchmarks.missing.plants import PLANTS
from benchmarks.missing.record import MIDDLE, SIZES, Case
from rtid.plain import plain

PACKAGES = (
    "rtid", "numpy", "scipy", "numba", "scikit-learn", "pysindy", "filterpy", "jax", "optax",
    "exudyn", "rumoca",
)  # fmt: skip
MOST_S = 3600.0  # for one method
Files = tuple[str, ...]


def write_records(folder: Path, seed: int, size: str, plants: Iterable[str]) -> list[Case]:
    """Every case that can be drawn, as a file that is kept."""
    (folder / "records").mkdir(parents=True, exist_ok=True)
    cases = []
    for name in plants:
        module = import_module(f"benchmarks.missing.plants.{name}")
        for wish in module.wishes(size):
            path = path_of(folder, wish.name)
            if not path.exists():
                case = wish.draw(draw_seed(seed, wish.name))
                if case is None:
                    print(f"{wish.name}: no machine could be drawn", file=sys.stderr)
                    continue
                path.write_bytes(pickle.dumps(case))
            cases.append(pickle.loads(path.read_bytes()))
    write_order(folder, cases)
    return cases


def run_method(folder: Path, name: str, most: int) -> None:
    """One method in a process of its own, on one thread."""
    single = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "MKL", "OMP", "NUMBA")}
    command = [sys.executable, "-m", "benchmarks.missing.collect", str(folder), name, str(most)]
    subprocess.run(command, check=True, timeout=MOST_S, env=os.environ | single)


def gathered(
    folder: Path, seed: int, size: str, cases: list[Case], methods: list[str], files: Files = FILES
) -> Any:
    """Everything that was measured, with what it was measured by."""
    said = {
        path_of(folder, case.name).stem: {
            "simulator": case.simulator, "law": case.law, "motion": case.motion,
            "hidden": case.hidden, "level": case.level, "effect": case.truth.effect,
            "for_all": case.for_all, "sha256": digest(case),
        }
        for case in cases
    }  # fmt: skip
    settings = {
        name: {"file": type(method).__module__, "settings": settings_of(method)}
        for name, method in methods_of(files).items()
        if name in methods
    }
    lines = [line for name in methods for line in results(folder, name) if line["case"] in said]
    return plain(
        {
            "seed": seed, "size": size, "python": platform.python_version(),
            "processor": processor(), "versions": versions(), "methods": settings,
            "cases": said, "results": lines,
        }
    )  # fmt: skip


def settings_of(method: object) -> dict[str, Any]:
    """The constants of a method's file: what its author has chosen."""
    module = import_module(type(method).__module__)
    kept = (str, int, float, tuple, list)
    return {
        key: value if isinstance(value, kept) else str(value)
        for key, value in vars(module).items()
        if key.isupper() and key not in ("METHODS", "NOTHING", "UNKNOWN")
    }


def versions() -> dict[str, str]:
    """Of what is installed."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def processor() -> str:
    """As the system calls it."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor()


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--size", choices=SIZES, default=MIDDLE)
    parser.add_argument("--out", type=Path, default=Path("out/missing"))
    parser.add_argument("--files", default=",".join(FILES), help="of benchmarks/missing/methods")
    parser.add_argument("--plants", default=",".join(PLANTS), help="of benchmarks/missing/plants")
    parser.add_argument(
        "--most", type=int, default=1000, help="records, of those drawn by lot; 0: what is there"
    )
    given = parser.parse_args()
    folder, began = given.out / str(given.seed), time.monotonic()
    cases = write_records(folder, given.seed, given.size, given.plants.split(","))
    print(f"{len(cases)} records, {time.monotonic() - began:.0f} s", flush=True)
    names = list(methods_of(tuple(given.files.split(","))))
    for name in names if given.most else ():
        run_method(folder, name, given.most)
        print(f"{name}: done, {time.monotonic() - began:.0f} s", flush=True)
    result = gathered(folder, given.seed, given.size, cases, names, tuple(given.files.split(",")))
    (folder / "result.json").write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
