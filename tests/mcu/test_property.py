"""Whatever the samples hold, the estimator in C stays within its memory and counts its refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtid.mcu.memory import COUNTS
from rtid.model import Gates
from tests.mcu.compiled import SANITISED, TAKEN, Outcome, Program
from tests.mcu.machine import small_valve

ROOM = 4  # blocks: fewer than the working points ask for
STEPS_US = st.sampled_from([1000] * 20 + [0, 1, -1, 40_000, 60_000, 2**40, -(2**62), 2**62])
ABSURD = [np.nan, np.inf, -np.inf, 1e308, -1e308, 1e30, 9.9e29, 1e9, 5e-324, -0.0]
SPANS = {"u": (-8.0, 8.0), "x": (0.0, 0.5)}


@pytest.fixture(scope="module", params=[False, True], ids=["double", "single"])
def program(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Program:
    """Under sanitizers, with little room; no range is declared but that of the position."""
    model = small_valve()
    signals = tuple(
        replace(s, minimum=-np.inf, maximum=np.inf) if s.name != "x" else s for s in model.signals
    )
    model = replace(model, signals=signals, gates=Gates(recovery_s=0.003))
    folder = tmp_path_factory.mktemp("property")
    return Program(model, folder, ROOM, single=request.param, options=SANITISED)


def samples(program: Program, seed: int, steps: list[int], absurd: float) -> NDArray[np.void]:
    """A run of the machine's signals, a share of them absurd."""
    rng, n = np.random.default_rng(seed), len(steps)
    out = np.zeros(n, program.layout.sample)
    clock = 2**40 + np.cumsum(np.array(steps, object))
    out["t_us"] = [int(np.clip(t, -(2**63), 2**63 - 1)) for t in clock]
    out["row"], out["gap"] = rng.random(n) < 0.8, rng.random(n) < 0.01
    for j, signal in enumerate(program.model.signals):
        low, high = SPANS.get(signal.name, (0.0, 8e6))
        walk = np.cumsum(rng.normal(0, 0.02, n)) + rng.random()
        values = low + (high - low) * np.abs((walk + 1) % 2 - 1)
        wild = rng.random(n) < absurd
        with np.errstate(over="ignore"):
            out["values"][:, j] = np.where(wild, rng.choice(ABSURD, n), values)
    return out


def check_counts(outcome: Outcome) -> None:
    """Every refusal is counted under its reason, and no sample is lost."""
    counts, verdicts = outcome.counts, outcome.verdicts
    assert counts["samples"] == len(verdicts)
    refused = [name for name in COUNTS[2:] if name not in ("block_changes", "restart_memory")]
    for name in refused:
        seen = int((verdicts == COUNTS.index(name)).sum())
        if name != "restart_gap":  # such a sample may also find the estimator recovering
            assert counts[name] == seen, name
    both = counts["restart_gap"] - int((verdicts == COUNTS.index("restart_gap")).sum())
    assert 0 <= both <= counts["recovering"]
    known = {TAKEN, *(COUNTS.index(name) for name in refused)}
    assert set(verdicts.tolist()) <= known
    assert counts["rows"] <= (verdicts == TAKEN).sum()


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 2**32 - 1),
    steps=st.lists(STEPS_US, min_size=1, max_size=1500),
    absurd=st.sampled_from([0.0, 0.001, 0.01, 0.3]),
)
def test_never_out_of_bounds(program: Program, seed: int, steps: list[int], absurd: float) -> None:
    """The sanitizers end the program at the first write or read outside, and at any overflow."""
    check_counts(program.run(samples(program, seed, steps, absurd).tobytes()))


def test_no_room_is_counted_and_what_was_learned_stays(program: Program) -> None:
    outcome = program.run(samples(program, 1, [1000] * 5000, 0.0).tobytes())
    assert outcome.counts["no_room"] > 0
    assert outcome.memory["n_slots"] == ROOM
    assert outcome.solution["finite"] == 1
    assert outcome.maps["mean_sd_m3s"].min() > 0


def test_any_bytes_as_samples(program: Program) -> None:
    """Random bit patterns in every field, flags included."""
    rng = np.random.default_rng(0)
    size = program.layout.sample.itemsize * 5000
    check_counts(program.run(rng.integers(0, 256, size, np.uint8).tobytes()))


def test_without_samples_nothing_is_known(program: Program) -> None:
    outcome = program.run(b"")
    assert outcome.memory["n_slots"] == 0
    assert outcome.solution["finite"] == 1
    assert outcome.solution["shared"][0] == 0.0
    assert outcome.solution["shared_sd"][0] > 1.0 / program.model.beta_nominal_pa
