"""Recursive = batch beyond the common case: bases, forms, modes, shapes of terms, other plants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.model import (
    BASES,
    BLENDED,
    COMMAND,
    COMMAND_ONLY,
    DROP_ONLY,
    LAPPED,
    NONE,
    POSITION,
    Chamber,
    Edge,
    Gates,
    Grid,
    Machine,
    Signal,
    Term,
)
from tests.estimator.cases import Case, draw_case
from tests.estimator.test_batch import accumulated, batch_of, check

FORMS = ("integral", "carry", "restart")


@pytest.mark.first_of(4)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("basis", [LAPPED, BLENDED])
@pytest.mark.parametrize("seed", range(2))
def test_overlapping_windows(seed: int, basis: str, form: str) -> None:
    check(draw_case(600 + seed, form, basis=basis, blocks=4, reverse=seed == 1))


@pytest.mark.parametrize("seed", range(3))
def test_restart_form(seed: int) -> None:
    check(draw_case(610 + seed, "restart", faults=seed, jitter=0.2 * seed))


@pytest.mark.first_of(4)
@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("form", FORMS)
def test_modes_with_two_edges_open(form: str, basis: str) -> None:
    case = draw_case(620, form, basis=basis, modes=True)
    check(case)
    edges = [e.name for e in case.model.edges]
    both = [edges.index("ab"), edges.index("at")]
    assert {both[0], both[1]} <= {b[0] for b in batch_of(case).blocks}


@pytest.mark.parametrize("form", FORMS)
def test_one_dimensional_maps(form: str) -> None:
    """Eq. (15): a function of dp per interval of the command, or of the command alone."""
    case = draw_case(630, form)
    edges = [
        replace(edge, terms=DROP_ONLY if k % 2 else COMMAND_ONLY)
        for k, edge in enumerate(case.model.edges)
    ]
    case = Case(replace(case.model, edges=tuple(edges)), case.t_s, case.values, case.flags)
    check(case)
    gram = accumulated(case)[0].gram
    unused = {0: (2, 4, 5), 1: (1, 3, 5)}
    for b, (edge, _, _) in enumerate(batch_of(case).blocks):
        for j in unused[edge % 2]:
            assert not gram[2 + 6 * b + j].any()


@pytest.mark.parametrize("form", FORMS)
def test_recovery_after_faults(form: str) -> None:
    plain, waiting = (draw_case(640, form, faults=3, recovery_s=s) for s in (0.0, 0.05))
    check(waiting)
    counters = accumulated(waiting)[1].engine[0]["counters"]
    assert counters[8] > 6 * 20
    assert counters[1] < accumulated(plain)[1].engine[0]["counters"][1]


def drive_case(form: str, basis: str) -> Case:
    """An electric drive, J domega/dt = k a(u) - b omega - load: no pressure, a map of u alone."""
    rng = np.random.default_rng(5)
    n = 2000
    t = 1e-3 * np.arange(n, dtype=np.float64)
    u = np.repeat(rng.uniform(-9, 9, n // 50), 50)
    load = np.cumsum(rng.standard_normal(n)) * 0.01
    omega = 50 * np.sin(2 * np.pi * 1.3 * t) + rng.standard_normal(n) * 0.1
    grid = Grid(np.linspace(-10, 10, 6), np.array([-1.0, 1.0]))
    amplifier = Edge(
        "amplifier", NONE, NONE, "u", 1, grid, -np.inf, 500.0, 1.0,
        basis=basis, terms=COMMAND_ONLY, signs=(("speed", 1),),
    )  # fmt: skip
    model = Machine(
        signals=(
            Signal("u", COMMAND),
            Signal("load", POSITION, noise=0.01),
            Signal("omega", POSITION, noise=0.1),
        ),
        chambers=(Chamber("speed", NONE, 1.0, 1, 0.0, disturbance=5.0),),
        edges=(amplifier,),
        position="omega",
        beta_nominal_pa=1.0,
        beta_bounds_pa=(0.5, 2.0),
        gates=Gates(hysteresis=0.05),
        form=form,
        terms=(
            Term("viscous", (("omega", -1.0),), (("speed", 1),), 1.0),
            Term("load", (("load", -1.0),), (("speed", 1),), 1.0),
        ),
    )
    return Case(model, t, np.column_stack([u, load, omega]).astype(np.float64), np.ones(n))


@pytest.mark.first_of(4)
@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("form", FORMS)
def test_a_plant_without_pressures(form: str, basis: str) -> None:
    check(drive_case(form, basis))
