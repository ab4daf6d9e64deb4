"""What the update costs in every form and basis, with candidate columns, and what a solve costs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from benchmarks.interleave import Job, side_by_side
from benchmarks.machine import chunk, model, record, warmed
from rtid.estimator.solution import solve
from rtid.model import BASES, Machine, Term

FORMS = ("integral", "carry", "restart")
SHAPES = ("linear", "root", "hinge")
CANDIDATES = 20


def machine(form: str, basis: str, candidates: int = 0) -> Machine:
    """Two chambers, 16 x 12 blocks per edge; candidates: shared terms of all shapes."""
    full = model((16, 12))
    edges = tuple(replace(edge, basis=basis) for edge in full.edges)
    terms = tuple(candidate(k) for k in range(candidates))
    return replace(full, form=form, edges=edges, terms=terms)


def candidate(k: int) -> Term:
    """A leak of the shape k between the chambers, from its own pressure on."""
    weights = (("p_a", 1.0), ("p_b", -1.0 + 0.05 * k))
    return Term(f"leak {k}", weights, (("a", -1), ("b", 1)), 1e-11, -1e5 * k, SHAPES[k % 3])


def update_job(name: str, of: Machine) -> Job:
    """The update over arrays."""
    data = chunk(record())
    state = warmed(of, data)
    return Job(name, lambda: state.advance(data), len(data))


def test_forms_and_bases(benchmark: Any) -> None:
    jobs = [update_job(f"{f}, {b}", machine(f, b)) for f in FORMS for b in BASES]
    title = "Update in every form and basis, two chambers whitened jointly, 16 x 12 blocks"
    side_by_side(benchmark, title, "sample", jobs, jobs[0].name, rounds=7)


def test_candidates(benchmark: Any) -> None:
    counts = (0, 5, CANDIDATES)
    jobs = [update_job(f"{n} candidate columns", machine("integral", "taylor", n)) for n in counts]
    title = "Update with live candidate columns, over arrays"
    side_by_side(benchmark, title, "sample", jobs, jobs[0].name, rounds=7)


def test_candidates_sample_by_sample(benchmark: Any) -> None:
    data = chunk(record())[:5000]
    jobs = []
    for n in (0, CANDIDATES):
        state = warmed(machine("integral", "taylor", n), data)
        rows = [data[k : k + 1] for k in range(len(data))]

        def run(state: Any = state, rows: Any = rows) -> None:
            for row in rows:
                state.advance(row)

        jobs.append(Job(f"{n} candidate columns", run, len(rows)))
    title = "Update with live candidate columns, State.advance per sample"
    asked = {jobs[0].name: "0.45 us", jobs[1].name: "3 us"}
    side_by_side(benchmark, title, "sample", jobs, jobs[0].name, rounds=7, asked=asked)


def test_solve_of_combinations(benchmark: Any) -> None:
    jobs = []
    for form, basis in (("integral", "taylor"), ("integral", "blended"), ("carry", "taylor")):
        of = machine(form, basis, CANDIDATES)
        state = warmed(of, chunk(record()))
        n = int(state.engine[0]["n_slots"])
        name = f"{form}, {basis}: {n} blocks, {CANDIDATES} candidates"
        jobs.append(Job(name, lambda of=of, state=state: solve(of, state)))  # type: ignore[misc]
    title = "The whole solution with 20 candidates"
    side_by_side(benchmark, title, "solve", jobs, jobs[0].name, rounds=5)
