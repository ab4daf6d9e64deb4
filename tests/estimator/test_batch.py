"""Recursive = batch: the sparse sums against dense rows that are made independently."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from rtid.estimator import state as state_module
from rtid.estimator.batch import BatchFit, fit_batch
from rtid.estimator.blocks import VALID
from rtid.estimator.factor import PRIOR_SD, SHARED_PRIOR, factorize
from rtid.estimator.solution import solve
from rtid.estimator.state import State, build
from rtid.estimator.sums import Normal, normal_equations
from rtid.model import BLENDED, TAYLOR, VELOCITY
from tests.estimator.cases import Case, draw_case, plant_case

FORMS = ("integral", "carry")
SUMS_LIMIT = 1e-8  # of the sums, each column in units of its own size
# Of the parameters, in units of the largest one.  The low-pass of the carry form leaves a joint
# condition number of 1e11 to 1e13 on short records, which normal equations feel.
LIMIT = {"integral": 1e-8, "carry": 1e-6}


def accumulated(case: Case) -> tuple[Normal, State]:
    state = build(case.model)
    state.advance(case.chunk)
    return normal_equations(state), state


@lru_cache(maxsize=1)  # a test looks at one case, again and again
def batch_of(case: Case) -> BatchFit:
    prior = (SHARED_PRIOR, PRIOR_SD**-2)
    return fit_batch(case.model, case.t_s, case.values, case.flags, prior=prior)


def differences(case: Case) -> dict[str, float]:
    """Largest differences of the sums, each column in units of its own size, and what happened."""
    batch = batch_of(case)
    normal, state = accumulated(case)
    diagonal = np.diag(batch.gram)
    # each column in its own size; one that no row saw is rounding, measured in 1e-6 of the largest
    size = np.sqrt(np.where(diagonal > 0, diagonal, 1e-12 * diagonal.max()))
    counters = state.engine[0]["counters"]
    return {
        "gram": float(np.abs((normal.gram - batch.gram) / np.outer(size, size)).max()),
        "right": float(np.abs((normal.right - batch.rows.T @ batch.y) / size).max())
        / float(np.linalg.norm(batch.y)),
        "square": abs(normal.square / float(batch.y @ batch.y) - 1),
        "blocks": len(batch.blocks),
        "columns": len(diagonal),
        "memories": int(counters[7]),
        "changes": int(counters[6]),
    }


def check(case: Case) -> dict[str, float]:
    found = differences(case)
    assert found["blocks"] > 3
    for what in ("gram", "right", "square"):
        assert found[what] <= SUMS_LIMIT, found
    return found


def parameter_error(case: Case) -> float:
    """Largest difference of theta_beta and of the valid blocks with cond(Phi'Phi) <= 1e6."""
    batch = batch_of(case)
    normal, state = accumulated(case)
    ns = int(state.engine[0]["n_shared"])
    theta = factorize(normal, ns).theta(normal.right)  # least squares, without the correction
    own = np.ones(len(theta), bool)
    for b, block in enumerate(solve(case.model, state).blocks):
        own[ns + 6 * b : ns + 6 * b + 6] = block.status == VALID and block.condition <= 1e6
    assert own.sum() > 20
    return float(np.abs(theta - batch.theta)[own].max() / np.abs(batch.theta[own]).max())


@pytest.mark.parametrize(
    ("seed", "form", "cross_port"),
    [(0, "integral", False), (2, "integral", True), (0, "carry", False)],
)
def test_parameters_of_random_plants(seed: int, form: str, cross_port: bool) -> None:
    assert parameter_error(plant_case(seed, form, cross_port)) <= LIMIT[form]


@pytest.mark.first_of(6)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(6))
def test_recursive_equals_batch(seed: int, form: str) -> None:
    check(draw_case(seed, form, reverse=seed % 2 == 1))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(3))
def test_one_chamber(seed: int, form: str) -> None:
    check(draw_case(100 + seed, form, chambers=1))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(3))
def test_gaps_missing_values_and_points_off_the_grid(seed: int, form: str) -> None:
    case = draw_case(200 + seed, form, faults=3)
    found = check(case)
    counters = accumulated(case)[1].engine[0]["counters"]
    assert found["memories"] == 0
    assert tuple(counters[2:6] > 0) == (True,) * 4


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("row_every", "jitter"), [(1, 0.4), (5, 0.0), (7, 0.4)])
def test_irregular_times_and_rare_rows(form: str, row_every: int, jitter: float) -> None:
    check(draw_case(300 + row_every, form, row_every=row_every, jitter=jitter, faults=1))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(3))
def test_chatter_at_block_borders(seed: int, form: str) -> None:
    found = check(draw_case(400 + seed, form, n=1000, blocks=4, chatter_pa=3e5))
    assert found["changes"] > 100


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(3))
def test_new_memory_when_too_many_blocks_ring(
    seed: int, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_module, "MAX_CLOSED", 7)
    found = check(draw_case(500 + seed, form, blocks=4, chatter_pa=1e5, faults=seed))
    assert found["memories"] > 3


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("terms", [1, 5, 18])
def test_more_shared_columns(terms: int, form: str) -> None:
    """Up to 20 shared columns: two compliances and 18 terms that are linear in the signals."""
    case = draw_case(11 + terms, form, terms=terms)
    found = check(case)
    assert found["columns"] - 6 * found["blocks"] == 2 + terms


@pytest.mark.parametrize("basis", [TAYLOR, BLENDED])
@pytest.mark.parametrize("seed", range(3))
def test_one_map_of_several_commands(seed: int, basis: str) -> None:
    """Commands that are in the same blocks of one map, and in others, at the same time."""
    case = draw_case(300 + seed, "integral", chambers=1, basis=basis)
    edge, column = case.model.edges[0], case.model.column("u")
    more = [replace(edge, name=f"{edge.name}{k}", command=f"u{k}", shares=edge.name) for k in "23"]
    signals = [replace(case.model.signals[column], name=e.command) for e in more]
    u = case.values[:, column]
    commands = np.stack([np.roll(u, 11), 0.5 * (u + np.roll(u, 40))], axis=1)
    model = replace(
        case.model,
        signals=(*case.model.signals, *signals),
        edges=(edge, more[0], *case.model.edges[1:], more[1]),
    )
    shared = replace(case, model=model, values=np.hstack([case.values, commands]))
    check(shared)
    assert model.n_cells == case.model.n_cells
    counted = {int(b["edge"]) for b in accumulated(shared)[1].blocks if b["rows"] > 0}
    assert counted and not counted & {1, len(model.edges) - 1}


@pytest.mark.parametrize("seed", range(2))
def test_a_map_over_a_measurement(seed: int) -> None:
    """A velocity, say, is linear between its samples, where a command is held."""
    case = draw_case(400 + seed, "integral", chambers=1)
    kinds = [replace(s, kind=VELOCITY) if s.name == "u" else s for s in case.model.signals]
    check(replace(case, model=replace(case.model, signals=tuple(kinds))))
