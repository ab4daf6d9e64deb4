"""Slow wear on board: carried over by the analyst, in the loop, in the history; never at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.compare.foretelling import rated_m3s
from rtid.daemon import jobs
from rtid.daemon.calendar import trend as trend_of
from rtid.daemon.wearing import LEAST, RATE, WearWatch
from rtid.estimator.chunk import to_chunk
from rtid.estimator.estimator import Estimator
from rtid.estimator.solution import Solution
from rtid.estimator.sums import Sums
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.campaign.guarding import Bench, Simulated
from tests.faults.harness import fault_free, machine, map_drift

WORN = 0.002
SLOWLY = 0.0012  # as much as RATE lets through in a publication


def worn(by: float) -> SimulatedPlant:
    """All valves let more through."""
    plant = SimulatedPlant()
    valves = tuple(replace(valve, gain=valve.gain * (1 + by)) for valve in plant.valves)
    return replace(plant, valves=valves)


@pytest.fixture(scope="module")
def minute() -> Estimator:
    return machine().learned(machine().frames).estimator


def later(minute: Estimator, by: float) -> Sums:
    """What is known behind half a minute of another machine."""
    estimator = minute.copy(with_history=False)
    estimator.history = None
    samples = simulate(worn(by), "rich", 5, 30.0).samples
    chunk = to_chunk(machine().project.model, samples, int(samples.t_us[0]))
    chunk[:, 0] += 100.0
    estimator.advance(chunk)
    return estimator.sums


@pytest.fixture(scope="module")
def known(minute: Estimator) -> tuple[Sums, Solution]:
    return minute.sums, fault_free()


def test_what_has_worn_is_carried_over_once(
    minute: Estimator, known: tuple[Sums, Solution]
) -> None:
    trend, total = WearWatch(), later(minute, WORN)
    assert trend.push(*known, 60) is None
    wear = trend.push(total, known[1], 96)
    assert wear is not None and np.abs(wear.gain - WORN).max() < 3e-4
    trend.forget()
    assert trend.push(total, known[1], 130) is None


def test_too_little_motion_says_nothing_yet(
    minute: Estimator, known: tuple[Sums, Solution]
) -> None:
    trend, total = WearWatch(), later(minute, WORN)
    assert trend.push(*known, 60) is None
    assert trend.push(total, known[1], 75) is None
    assert trend.push(total, known[1], 96) is not None, "what was known before is held against it"


def test_a_machine_as_before_goes_on_untouched(
    minute: Estimator, known: tuple[Sums, Solution]
) -> None:
    trend = WearWatch()
    assert trend.push(*known, 60) is None
    assert trend.push(later(minute, 0.0), known[1], 96) is None


def test_nothing_wears_at_once(minute: Estimator, known: tuple[Sums, Solution]) -> None:
    trend = WearWatch()
    assert trend.push(*known, 60) is None
    wear = trend.push(later(minute, 0.1), known[1], 96)
    assert wear is not None and np.abs(wear.gain).max() == pytest.approx(36 * RATE)


def test_an_estimate_that_was_taken_back_is_compared_with_nothing(
    minute: Estimator, known: tuple[Sums, Solution]
) -> None:
    trend = WearWatch()
    assert trend.push(later(minute, WORN), known[1], 60) is None
    assert trend.push(*known, 96) is None, "it knows less: it is no later one"


@pytest.mark.long
def test_the_daemon_follows(tmp_path: Path) -> None:
    """Learner, baseline and what is published go with the machine; the history tells of it."""
    rate = rated_m3s(machine().project.model) / 3e6
    bench = Bench(SimulatedPlant(), machine().project, machine().catalog, 1, rate).publishing(25.0)
    daemon = Simulated(bench, tmp_path, 0.0)
    daemon.hear(bench.run(60.0, 1))
    before, answers = daemon.published, list[jobs.Worn]()
    take = daemon.analyst._answer

    def note(answer: jobs.Answer) -> None:
        answers.extend([answer] if isinstance(answer, jobs.Worn) else [])
        take(answer)

    daemon.analyst._answer = note
    daemon.hear(bench.run(60.0, 2, plant=worn(SLOWLY)))
    daemon.stop()
    assert np.isnan(daemon.alarm_s), daemon.text
    gone = np.prod([1 + answer.wear.gain for answer in answers], axis=0) - 1
    assert np.abs(gone - SLOWLY).max() < 3e-4
    guard = daemon.analyst._guard
    assert guard is not None and np.allclose(guard.worn, gone)
    assert 0.5 * LEAST < map_drift(before, daemon.published) < 2 * SLOWLY
    lines = {line.name: line.points for line in trend_of(tmp_path, 0.0)}
    assert lines["wear of pa"][-1][1] == pytest.approx(gone[0])
    again = Simulated(bench, tmp_path, 300.0)
    assert again.analyst._guard is not None
    assert np.allclose(again.analyst._guard.worn, gone), "a restart knows it"
