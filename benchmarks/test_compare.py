"""What the comparison adds to a replay: every view of a trace of 110 s at 1 kHz, warm."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.interleave import Job, interleave, report
from rtid.compare import compare, examine, learned, simulate
from rtid.estimator.chunk import to_chunk
from rtid.estimator.published import publish
from rtid.estimator.record import fit_record
from rtid.sim.declare import declared_model
from rtid.sim.run import simulate as run_plant
from rtid.sim.simulated_plant import SimulatedPlant

SECONDS = 110.0
SEEN = 80_000


def test_compare(benchmark: Any) -> None:
    run = run_plant(SimulatedPlant(), "rich", seed=1, duration_s=SECONDS)
    model = declared_model(run.plant)
    chunk = to_chunk(model, run.samples, 0)
    fit = fit_record(model, chunk[:SEEN])
    candidate = learned(fit, publish(fit.solution))

    def whole() -> None:
        seen = examine(model, candidate, chunk[:SEEN], seen=True)
        examine(model, candidate, chunk[SEEN:], before=seen.equation)

    jobs = [
        Job("record path", lambda: fit_record(model, chunk[:SEEN])),
        Job("publish the map", lambda: publish(fit.solution)),
        Job("equation residual", lambda: compare(model, candidate, chunk, seen=True)),
        Job("one free run, smoother included", lambda: simulate(model, candidate, chunk)),
        Job("all views of both parts", whole),
    ]
    times = benchmark.pedantic(interleave, args=(jobs, 5), rounds=1)
    rows = [
        {"name": name, "text": f"{float(np.median(seconds)):.2f} s"}
        for name, seconds in times.items()
    ]
    report(benchmark, f"Comparison of {SECONDS:.0f} s at 1 kHz, one map, warm", "part", rows)
