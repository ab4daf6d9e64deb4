"""A solve for all maps, with covariances, on demand: about 20, 100 and more visited blocks."""

from __future__ import annotations

from typing import Any

from benchmarks.interleave import Job, side_by_side
from benchmarks.machine import chunk, model, one_chamber, record, warmed
from rtid.estimator.factor import factorize, one_thread
from rtid.estimator.solution import solve
from rtid.estimator.sums import normal_equations
from rtid.model import Machine


def jobs_of(machine: Machine) -> list[Job]:
    """Parameters and covariance alone, and the whole solution with every block's status."""
    state = warmed(machine, chunk(record()))
    n_shared, n_blocks = int(state.engine[0]["n_shared"]), int(state.engine[0]["n_slots"])

    def estimate() -> None:
        normal = normal_equations(state)
        with one_thread():
            factor = factorize(normal, n_shared)
            factor.theta(normal.right)
            factor.cov()

    size = f"{n_blocks} blocks, {n_shared + 6 * n_blocks} unknowns"
    return [
        Job(f"{size}: estimate and covariance", estimate),
        Job(f"{size}: the whole solution with statuses", lambda: solve(machine, state)),
    ]


def test_solve(benchmark: Any) -> None:
    machines = (one_chamber(model((7, 6))), model((16, 12)), model())
    jobs = [job for machine in machines for job in jobs_of(machine)]
    title, asked = "A solve for all maps, on demand", {jobs[1].name: "1 ms"}
    side_by_side(benchmark, title, "solve", jobs, jobs[0].name, rounds=7, asked=asked)
