"""Recursive = batch in any combination of form, basis, mask, grid, modes, terms and faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtid.model import BASES, BOTH, COMMAND_ONLY, DROP_ONLY, TAYLOR, Edge, Grid, Machine
from rtid.plain import FloatArray
from tests.estimator.cases import Case, draw_case
from tests.estimator.test_batch import SUMS_LIMIT, differences

FORMS = ("integral", "carry", "restart")
MASKS = (BOTH, BOTH, COMMAND_ONLY, DROP_ONLY)
MOST_OVERLAPPING = 4  # edges that are always open: 2 x 2 windows each, 16 open blocks


@st.composite
def cases(draw: st.DrawFn) -> Case:
    case = draw_case(
        draw(st.integers(0, 10**6)),
        draw(st.sampled_from(FORMS)),
        n=draw(st.integers(260, 340)),
        chambers=draw(st.sampled_from([1, 2])),
        blocks=draw(st.integers(2, 6)),
        chatter_pa=draw(st.sampled_from([0.0, 5e3, 3e5])),
        jitter=draw(st.sampled_from([0.0, 0.4])),
        row_every=draw(st.sampled_from([1, 1, 7])),
        faults=draw(st.integers(0, 3)),
        terms=draw(st.sampled_from([0, 2, 6])),
        modes=draw(st.booleans()),
        recovery_s=draw(st.sampled_from([0.0, 0.02])),
        reverse=draw(st.booleans()),
    )
    always_open = draw(st.booleans())
    edges = case.model.edges[:MOST_OVERLAPPING] if always_open else case.model.edges
    changed = tuple(_changed(draw, edge, always_open) for edge in edges)
    return replace(case, model=replace(case.model, edges=changed))


def _changed(draw: st.DrawFn, edge: Edge, always_open: bool) -> Edge:
    basis, terms = draw(st.sampled_from(BASES)), draw(st.sampled_from(MASKS))
    u, dp = edge.grid.u_v, edge.grid.dp_pa
    if always_open:
        edge, u = replace(edge, safe_band_v=-np.inf), np.concatenate([[-12.0, -3.0], u])
    along_u, along_dp = draw(st.booleans()), draw(st.booleans())
    if not along_u or (basis != TAYLOR and terms == DROP_ONLY):
        u = _ends(u)
    if not along_dp or (basis != TAYLOR and terms == COMMAND_ONLY):
        dp = _ends(dp)
    return replace(edge, basis=basis, terms=terms, grid=Grid(u, dp))


def _ends(border: FloatArray) -> FloatArray:
    """One single interval in place of many."""
    return border[[0, -1]]


def text(model: Machine) -> str:
    """What a failure is about."""
    edges = [
        f"{e.name} {e.basis} {e.terms} {e.grid.shape} {e.safe_band_v:.2g}" for e in model.edges
    ]
    return f"{model.form}, lag {model.lag.nominal_s}, {len(model.terms)} terms, {edges}"


@settings(
    max_examples=15,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.large_base_example],
)
@given(cases())
def test_recursive_equals_batch_in_any_combination(case: Case) -> None:
    found = differences(case)
    for what in ("gram", "right", "square"):
        assert found[what] <= SUMS_LIMIT, (text(case.model), found)
