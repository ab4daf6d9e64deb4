"""Measure several jobs in one run, A B C A B C ..., so that a drifting clock rate hits all alike.

The same code was seen to drift by 1.6 x between two runs one after the other; the ratio of two
jobs within one round does not.  Times are of the processor, all threads together: what else the
computer does is not in them.  Medians and ratios go to pytest-benchmark's `extra_info`, where
`benchmarks.table` finds them.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from time import process_time
from types import MappingProxyType
from typing import Any

NOTHING_ASKED: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class Job:
    """A thing to time: `run` works through `items` samples, frames or solves."""

    name: str
    run: Callable[[], object]
    items: int = 1


def interleave(jobs: Sequence[Job], rounds: int) -> dict[str, list[float]]:
    """Seconds per item of every job in every round; one round before them warms caches and JIT."""
    times: dict[str, list[float]] = {job.name: [] for job in jobs}
    for job in jobs:
        job.run()
    gc.collect()
    gc.disable()
    try:
        for _ in range(rounds):
            for job in jobs:
                start = process_time()
                job.run()
                times[job.name].append((process_time() - start) / job.items)
    finally:
        gc.enable()
    return times


def ratio(times: dict[str, list[float]], name: str, base: str) -> float:
    """Median over the rounds of name / base, each pair taken from the same round."""
    return median(a / b for a, b in zip(times[name], times[base], strict=True))


def side_by_side(  # `benchmark` is pytest-benchmark's fixture, which has no types
    benchmark: Any,
    title: str,
    unit: str,
    jobs: Sequence[Job],
    base: str,
    rounds: int = 15,
    asked: Mapping[str, str] = NOTHING_ASKED,
) -> dict[str, list[float]]:
    """Time the jobs interleaved, report their medians and ratios to `base`, return all times.

    asked: what some of them should reach, by name, in words.
    """
    times: dict[str, list[float]] = benchmark.pedantic(interleave, args=(jobs, rounds), rounds=1)
    rows = [
        {"name": name, "seconds": median(seconds), "ratio": ratio(times, name, base)}
        | ({"asked": asked[name]} if name in asked else {})
        for name, seconds in times.items()
    ]
    report(benchmark, title, unit, rows)
    return times


def report(benchmark: Any, title: str, unit: str, rows: Sequence[dict[str, Any]]) -> None:
    """Hand rows of {name, seconds or text, ratio and asked or absent} to the table, print them."""
    benchmark.extra_info.update(title=title, unit=unit, rows=list(rows))
    print(f"\n{title}")
    for row in rows:
        value = row.get("text") or f"{row['seconds'] * 1e6:12.3f} us per {unit}"
        times = f"{row['ratio']:10.2f} x" if "ratio" in row else ""
        asked = f"   asked: {row['asked']}" if "asked" in row else ""
        print(f"  {row['name']:48s} {value} {times}{asked}")
