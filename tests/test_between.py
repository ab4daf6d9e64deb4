"""What a log does not say of a command between its samples, against commands that are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from firmware_bridge.sources.table import jumps
from rtid.plain import FloatArray
from rtid.project import load
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.between import unknown_between
from rtid.trace.check import BETWEEN_ROWS, judge
from rtid.trace.signals import read_recording

N, EACH, DT_S = 100_000, 20, 1e-3  # samples of the controller, of which each so many-th is logged
T_S = np.linspace(0.0, DT_S * (N - 1), N)
RNG = np.random.default_rng(3)
WALK, TREMBLE = np.cumsum(RNG.normal(0.0, 0.01, N)), RNG.normal(0.0, 0.05, N)


def of_sums(fine: FloatArray) -> float:
    """What the line between logged samples misses of the sum of 20 of their steps, per step."""
    u = fine[::EACH]
    missed = fine.reshape(-1, EACH).mean(axis=1)[:-1] - 0.5 * (u[1:] + u[:-1])
    whole = missed[: len(missed) // 20 * 20].reshape(-1, 20).sum(axis=1)
    return float(np.sqrt(np.mean(whole**2) / 20))


@pytest.mark.parametrize("fine", [WALK, TREMBLE, WALK + TREMBLE], ids=["walk", "tremble", "both"])
def test_it_is_what_the_line_between_samples_misses(fine: FloatArray) -> None:
    sd, step_s = unknown_between(T_S[::EACH], fine[::EACH])
    assert sd == pytest.approx(of_sums(fine), rel=0.12)
    assert step_s == pytest.approx(EACH * DT_S)


def test_a_ramp_and_a_slow_swing_are_known() -> None:
    for fine in (np.abs(T_S % 4.0 - 2.0), np.sin(np.pi * T_S)):
        assert unknown_between(T_S[::EACH], fine[::EACH])[0] < 1e-3


def test_a_jump_is_none_of_it() -> None:
    """When it came, nobody knows: nothing is integrated across it."""
    fine = 0.2 * WALK
    fine[N // 2 :] += 4.0
    step = jumps(fine[::EACH])
    assert np.flatnonzero(step).tolist() == [N // 2 // EACH - 1]
    sd, _ = unknown_between(T_S[::EACH], fine[::EACH])
    assert sd == pytest.approx(unknown_between(T_S[::EACH], 0.2 * WALK[::EACH])[0], rel=0.01)


def test_what_trembles_has_no_jumps_and_what_rests_tells_of_nothing() -> None:
    assert not jumps(TREMBLE).any()
    assert not jumps(np.zeros(9)).any()
    assert not jumps(np.zeros(2)).any()
    assert unknown_between(T_S[:200], np.zeros(200))[0] == 0.0


@pytest.mark.parametrize(("each", "says"), [(1, False), (5, True)])
def test_check_says_which_noise_a_held_command_may_have(
    each: int, says: bool, tmp_path: Path
) -> None:
    trace = tmp_path / "run.parquet"
    write_run(trace, simulate(SimulatedPlant(), "rich", 0, 12.0), 0, "rich")
    table = pq.read_table(trace)
    pq.write_table(table.take(np.arange(0, len(table), each)), trace)
    file = trace.with_suffix(".toml")
    for is_held in (True, False):
        if not is_held:
            file.write_text(file.read_text().replace('hold = "zero"', 'hold = "linear"'))
        project = load(file)
        read, by = read_recording(project, trace), project.table_assembly
        assert by is not None
        report = judge(
            project.model, by, read.samples, read.series, read.messages, read.refused, 0.5
        )
        told = [f for f in report.findings if BETWEEN_ROWS in f.text]
        assert [f.subject for f in told] == ["u"] * (says and is_held)
        assert all('hold = "linear"' in f.remedy for f in told)
