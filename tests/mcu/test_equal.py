"""The estimator in C beside the Python one on the same samples: sums and solution.

Both lie within 2e-14 of the exact sums, relative to their columns (measured against the same C in
80-bit numbers).  What that does to an unknown depends on the record: `rounding_of`, ROUNDINGS.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.mcu.emulated import Record
from rtid.mcu.valve import one_valve
from rtid.model import COMMAND_ONLY, DROP_ONLY, Machine
from tests.estimator.cases import Case, draw_case
from tests.mcu.compiled import SANITISED, Program
from tests.mcu.machine import (
    BLOCKS,
    EPS,
    LIMIT,
    Reference,
    full_valve,
    rig_record,
    rig_reference,
    small_valve,
    solutions_apart,
    sums_apart,
)
from tests.mcu.records import repeated, valve

EQUAL, EQUAL_SUMS = 1e-10, 1e-12
SHARED_ROUNDING, FLOW_ROUNDING = 4e-5, 3e-4  # rtid_estimator_sums.h: what float states
ROUNDINGS = 4.0  # of every sum and of the solution's own numbers, half of them in C
RUNS = range(1, 17)
NO_REFUSALS = {"no_room": 0, "busy": 0}
VALID = {"learning": 0, "valid": 1, "stale": 2}


@pytest.fixture(scope="module")
def double(tmp_path_factory: pytest.TempPathFactory) -> Program:
    return Program(small_valve(), tmp_path_factory.mktemp("double"), BLOCKS)


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Program:
    return Program(small_valve(), tmp_path_factory.mktemp("single"), BLOCKS, single=True)


@pytest.mark.parametrize("run", RUNS)
def test_double_precision_on_the_rig(double: Program, shared: Path, run: int) -> None:
    """Sums to 1e-12; beta with its deviation, block means, terms of blocks up to SURE: to 1e-10."""
    record, reference = rig_reference(shared, run)
    outcome = double.run(double.samples(record.t_us, record.values, record.flags))
    assert outcome.counts == reference.counts | NO_REFUSALS
    assert sums_apart(outcome, reference) <= EQUAL_SUMS
    apart = solutions_apart(outcome, reference)
    assert max(apart.beta, apart.beta_sd, apart.flows, apart.terms[0]) <= EQUAL
    assert apart.terms[1] <= 2 * EPS * LIMIT
    assert apart.roundings <= ROUNDINGS
    statuses = [VALID[block.status] for block in reference.solution.blocks]
    assert outcome.maps["status"].tolist() == statuses
    assert outcome.solution["rho"] == pytest.approx(reference.solution.rho, rel=1e-7)


@pytest.mark.parametrize("run", RUNS)
def test_single_precision_on_the_rig(single: Program, shared: Path, run: int) -> None:
    """The stated bound: beta to 1e-5, block means to 2e-6 of the rated flow and 0.05 of their sd.

    What is left is the rounding of the samples, up to 1e-6 of a block's width.  It is stated: a
    block whose deviation was just small enough is still learning.
    """
    record, reference = rig_reference(shared, run)
    outcome = single.run(single.samples(record.t_us, record.values, record.flags))
    assert outcome.counts == reference.counts | NO_REFUSALS
    assert outcome.solution["raised"] == 0
    assert sums_apart(outcome, reference) <= 2e-5
    apart = solutions_apart(outcome, reference)
    assert apart.beta <= 1e-5
    sd = reference.solution.compliance_cov[0, 0] ** 0.5
    stated = float(np.hypot(sd, SHARED_ROUNDING * reference.solution.compliance[0]))
    assert outcome.solution["shared_sd"][0] == pytest.approx(stated, rel=1e-5)
    assert apart.flows <= 2e-6
    assert apart.sds <= 0.05
    assert outcome.maps["status"].tolist() == [VALID[s] for s in with_rounding(reference)]


def with_rounding(reference: Reference) -> list[str]:
    """Statuses of double's blocks: valid ones are learning where their rounding is too much."""
    blocks, model = reference.solution.blocks, reference.solution.model
    known = [b for b in blocks if b.rows >= model.gates.min_rows]
    largest = {
        i: max((abs(b.mean_flow_m3s) for b in known if b.edge == i), default=edge.rated_q_m3s)
        for i, edge in enumerate(model.edges)
    }
    statuses = []
    for b in blocks:
        rounding = FLOW_ROUNDING * model.edges[b.edge].rated_q_m3s
        sd = float(np.sqrt(b.mean_phi @ b.cov @ b.mean_phi + rounding**2))
        is_known = b.status != "valid" or sd <= model.gates.max_sd_share * largest[b.edge]
        statuses.append(b.status if is_known else "learning")
    return statuses


def test_float_states_its_own_rounding(tmp_path: Path) -> None:
    """More rows make deviations smaller, not the rounding of samples: it is within what is said."""
    model, taken = valve(24), repeated(60.0)
    double, single = (Program(model, tmp_path / str(k), 24, single=k) for k in (False, True))
    runs = [p.run(p.samples(taken.t_us, taken.values, taken.flags)) for p in (double, single)]
    truth, rounded = (run.maps for run in runs)
    off = np.abs(truth["mean_m3s"] - rounded["mean_m3s"])
    valid = rounded["status"] == VALID["valid"]
    assert valid.sum() > 8
    assert (off <= rounded["mean_sd_m3s"])[valid].all()
    beta = [run.solution["shared"][0] for run in runs]
    assert abs(beta[1] - beta[0]) <= runs[1].solution["shared_sd"][0]
    known = truth["condition"] <= model.gates.condition_limit
    assert rounded["status"].tolist() == truth["status"].tolist()
    terms = np.abs(truth["theta"] - rounded["theta"]).max(axis=1) / np.abs(truth["theta"]).max()
    assert terms[known].max() <= 5e-4


def test_asking_changes_nothing(double: Program, shared: Path) -> None:
    """Frozen and solved 146 times on the way, at rebases and between them."""
    record, reference = rig_reference(shared, 1)
    samples = double.samples(record.t_us, record.values, record.flags)
    outcome = double.run(samples, ask_every=750)
    assert outcome.counts == reference.counts | NO_REFUSALS
    assert sums_apart(outcome, reference) <= EQUAL_SUMS


def test_on_a_fine_grid_whose_memory_overflows(tmp_path: Path, shared: Path) -> None:
    """143 blocks of the packaged example; more of them ring at once than there is room for."""
    model = full_valve()
    record = rig_record(shared, 1, model)
    reference = Reference.of(model, record)
    program = Program(model, tmp_path, len(reference.solution.blocks))
    outcome = program.run(program.samples(record.t_us, record.values, record.flags))
    assert outcome.counts == reference.counts | NO_REFUSALS
    assert outcome.counts["restart_memory"] > 0
    assert sums_apart(outcome, reference) <= EQUAL
    apart = solutions_apart(outcome, reference)
    assert max(apart.beta, apart.beta_sd, apart.flows, *apart.terms) <= EQUAL


def drawn(seed: int) -> tuple[Machine, Record]:
    """A random declaration of one chamber with faults in its record; two edges open at once."""
    case: Case = draw_case(
        seed, faults=4, terms=seed % 7, jitter=0.3, row_every=1 + seed % 3, recovery_s=0.0205
    )
    # The first half of a map may have fewer terms
    terms = (DROP_ONLY, COMMAND_ONLY)[seed % 2]
    edges = (replace(case.model.edges[0], terms=terms), *case.model.edges[1:])
    chamber = case.model.chambers[seed % 2].name
    whole = replace(case.model, edges=edges)
    whole = replace(whole, terms=tuple(t for t in whole.terms if t.volume in ("", chamber)))
    model = one_valve(whole, chamber)
    columns = [[s.name for s in whole.signals].index(s.name) for s in model.signals]
    t_us = np.rint(case.t_s * 1e6).astype(np.int64)
    return model, Record(t_us, case.values[:, columns], case.flags)


@pytest.mark.first_of(4)
@pytest.mark.parametrize("seed", range(12))
def test_random_machines_differ_by_rounding(tmp_path: Path, seed: int) -> None:
    """Records of 1.5 s, most of whose blocks are known badly: all unknowns within the bound."""
    model, record = drawn(seed)
    reference = Reference.of(model, record)
    program = Program(model, tmp_path)
    outcome = program.run(program.samples(record.t_us, record.values, record.flags))
    assert sums_apart(outcome, reference) <= EQUAL_SUMS
    assert solutions_apart(outcome, reference).roundings <= ROUNDINGS


@pytest.mark.first_of(1)
@pytest.mark.parametrize("seed", range(3))
def test_random_machines_under_sanitizers(tmp_path: Path, seed: int) -> None:
    """Gaps, NaN, values out of range, points off the grid, rows now and then, shared terms."""
    model, record = drawn(seed)
    reference = Reference.of(model, record)
    program = Program(model, tmp_path, options=SANITISED)
    assert program.layout.sizes.open == 2
    outcome = program.run(program.samples(record.t_us, record.values, record.flags))
    assert outcome.counts == reference.counts | NO_REFUSALS
    assert min(outcome.counts[name] for name in ("not_finite", "out_of_range", "restart_gap")) > 0
    assert sums_apart(outcome, reference) <= EQUAL
    theirs = reference.solution
    assert outcome.solution["shared"][0] == pytest.approx(theirs.compliance[0], rel=1e-8)
    assert outcome.solution["shared"][1:] == pytest.approx(theirs.terms, rel=1e-6)
    assert outcome.solution["shared_sd"][1:] == pytest.approx(
        np.sqrt(np.diag(theirs.terms_cov)), rel=1e-6
    )
    blocks = outcome.memory["block"][: outcome.memory["n_slots"]]
    assert blocks["rows"].tolist() == [block.rows for block in theirs.blocks]
    assert blocks["dwell_us"] * 1e-6 == pytest.approx([b.dwell_s for b in theirs.blocks])
    places = np.stack([blocks["edge"], blocks["u"], blocks["dp"]], axis=1)
    assert places.tolist() == [[b.edge, b.i, b.j] for b in theirs.blocks]
