"""What `State` promises: chunks do not matter, copies go on alike, reading changes nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rtid.estimator import state as state_module
from rtid.estimator.solution import solve
from rtid.estimator.state import State, build
from tests.estimator.cases import Case, draw_case

FORMS = ("integral", "carry")
ROOT = Path(__file__).parents[2]


def learned(case: Case, size: int) -> State:
    state = build(case.model)
    for k in range(0, len(case.chunk), size):
        state.advance(case.chunk[k : k + size])
    return state


def same(a: State, b: State) -> bool:
    return all(x.tobytes() == y.tobytes() for x, y in zip(a.arrays, b.arrays, strict=True))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    "options", [{}, {"faults": 2, "jitter": 0.3}, {"chatter_pa": 2e5, "blocks": 5}]
)
def test_chunks_do_not_matter(
    form: str, options: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_module, "FIRST_BLOCKS", 16)  # the tables must grow on the way
    case = draw_case(7, form, n=5000, **options)  # type: ignore[arg-type]
    whole = learned(case, len(case.t_s))
    assert len(whole.blocks) > 16
    for size in (1, 7, 4096):
        assert same(whole, learned(case, size))


@pytest.mark.parametrize("form", FORMS)
def test_a_copy_goes_on_bit_for_bit(form: str) -> None:
    case = draw_case(8, form, n=2000, faults=1)
    state = build(case.model)
    state.advance(case.chunk[:900])
    copy = state.copy()
    stored = State(*(np.frombuffer(a.tobytes(), a.dtype).copy() for a in state.arrays))
    for each in (state, copy, stored):
        each.advance(case.chunk[900:])
    assert same(state, copy)
    assert same(state, stored)


@pytest.mark.parametrize("form", FORMS)
def test_reading_changes_nothing(form: str) -> None:
    case = draw_case(9, form, n=1500)
    quiet, read = build(case.model), build(case.model)
    for k in range(0, 1500, 100):
        quiet.advance(case.chunk[k : k + 100])
        read.advance(case.chunk[k : k + 100])
        before = read.copy()
        read.settled()
        solve(case.model, read)
        assert same(before, read)
    assert same(quiet, read)


def test_settling_twice_is_settling_once() -> None:
    case = draw_case(10, "integral")
    state = learned(case, 4096).settled()
    again = state.settled()
    np.testing.assert_array_equal(state.blocks["gram"], again.blocks["gram"])
    np.testing.assert_array_equal(state.engine[0]["shared"], again.engine[0]["shared"])


UNCOMPILED = """
import pathlib, sys
import numba, numpy as np
from rtid.kernels import engine, housekeeping, layout
from tests.estimator.cases import draw_case
from tests.estimator.test_contract import learned

if numba.config.DISABLE_JIT:  # interpreted, e.running needs a record type
    for name in ("ENGINE", "CELL", "CLOSED", "BLOCK", "PAIR"):
        setattr(engine, name, np.dtype((np.record, getattr(layout, name))))
    def with_attributes(kernel):
        return lambda *arrays: kernel(*(a.view((np.record, a.dtype)) for a in arrays))
    for name in ("settle", "clear"):
        setattr(housekeeping, name, with_attributes(getattr(housekeeping, name)))
for form in ("integral", "carry"):
    case = draw_case(11, form, n=300, faults=1, chatter_pa=5e4)
    state = learned(case, 4096)
    housekeeping.settle(state.engine, state.closed, state.blocks, state.pairs)
    np.savez(pathlib.Path(sys.argv[1]) / form, shared=state.engine[0]["shared"],
             own=state.blocks["gram"], cross=state.blocks["shared"], pairs=state.pairs["gram"],
             counters=state.engine[0]["counters"], cov=state.engine[0]["cov"])
"""


def test_compiled_equals_interpreted(tmp_path: Path) -> None:
    for disabled in ("0", "1"):
        (tmp_path / disabled).mkdir()
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-c", UNCOMPILED, str(tmp_path / disabled)]
        subprocess.run(command, check=True, env=environment, cwd=ROOT, timeout=120)
    for form in FORMS:
        compiled = np.load(tmp_path / "0" / f"{form}.npz")
        interpreted = np.load(tmp_path / "1" / f"{form}.npz")
        for name in compiled.files:
            size = np.abs(compiled[name]).max()
            np.testing.assert_allclose(
                interpreted[name], compiled[name], rtol=1e-9, atol=1e-12 * size
            )
