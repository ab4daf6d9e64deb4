"""A verdict from decoded samples: 80 s at 1 kHz, two chambers, the whole catalogue, warm.

Times are of the processor, since the machine may be shared; memory is the peak of what the
diagnosis itself allocates (tracemalloc, which counts numpy's arrays), measured in a run of its own.
"""

from __future__ import annotations

import tracemalloc
from statistics import median
from time import process_time
from typing import Any

import pytest

from benchmarks.interleave import report
from rtid.diagnose.diagnosis import search
from rtid.estimator.chunk import to_chunk
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.hidden import hide
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate
from tests.campaign.plants import grid

RECORD_S, LEARN_S, TEST_S = 110.0, 80.0, 83.0
SEED, ROUNDS = 3, 3

HIDDEN = (
    ("nothing", 0.0),
    ("internal_leakage_laminar", 4e-12),
    ("entrained_air", 0.05),
    ("input_delay", 12e-3),
)


def record(effect: str, strength: float) -> tuple[Machine, FloatArray, FloatArray]:
    """Model, identification and held-out part of a random machine with a hidden effect."""
    plant = draw(SEED)
    if strength:
        plant = hide(plant, effect, strength)
    run = simulate(plant, "rich_record", SEED, RECORD_S)
    model = declared_model(plant, seed=SEED, grid=grid(plant.p_supply_pa))
    chunk = to_chunk(model, run.samples, 0)
    t_s = chunk[:, 0]
    return model, chunk[t_s < LEARN_S], chunk[t_s >= TEST_S]


def peak_mb(parts: tuple[Machine, FloatArray, FloatArray]) -> float:
    """Most that one diagnosis has allocated at a time, MB."""
    tracemalloc.start()
    try:
        search(*parts)
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("effect", "strength"), HIDDEN, ids=[name for name, _ in HIDDEN])
def test_verdict(benchmark: Any, effect: str, strength: float) -> None:
    parts = record(effect, strength)
    result = search(*parts)  # kernels compiled
    processor: list[float] = []

    def once() -> None:
        spent = process_time()
        search(*parts)
        processor.append(process_time() - spent)

    benchmark.pedantic(once, rounds=ROUNDS)
    memory = peak_mb(parts)
    rows = [
        {
            "name": "processor",
            "text": f"{median(processor):.2f} s",
            "asked": "4 s, with exact refits" if strength else "2 s",
        },
        {"name": "peak memory", "text": f"{memory:.0f} MB", "asked": "300 MB"},
    ]
    report(benchmark, f"Verdict on 80 s at 1 kHz with {effect}: {result.verdict}", "record", rows)
    benchmark.extra_info.update(processor_s=median(processor), peak_mb=memory)
