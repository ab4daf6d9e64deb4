"""Slow wear: what has changed since, and what was learned carried over to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from rtid.estimator.chunk import to_chunk
from rtid.estimator.estimator import Estimator
from rtid.estimator.factor import misfit
from rtid.estimator.solution import Solution, solve
from rtid.estimator.sums import Sums
from rtid.estimator.wear import Wear, carried_over, changed, wear_since
from rtid.model import Machine, Term
from rtid.plain import FloatArray
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.faults.harness import machine

LEAK = 1e-12  # m3/s/Pa
LEAKS = Term("leak", (("p_a", 1.0), ("p_b", -1.0)), (("a", -1), ("b", 1)), LEAK, sd=0.5)
NOTHING = Wear(np.zeros(4), np.zeros(1))
CHANGES = (0.004, -0.003, 0.002, 0.006)


def chunk_of(plant: SimulatedPlant, seed: int, seconds: float, begin_s: float) -> FloatArray:
    samples = simulate(plant, "rich", seed, seconds).samples
    chunk = to_chunk(machine().project.model, samples, int(samples.t_us[0]))
    chunk[:, 0] += begin_s
    return chunk


def leaking(times: float) -> SimulatedPlant:
    plant = SimulatedPlant()
    return replace(plant, extra=plant.extra._replace(internal_laminar=times * LEAK))


@dataclass(frozen=True)
class Learned:
    """A minute of a machine with a leak that is learned beside the maps."""

    model: Machine
    estimator: Estimator
    sums: Sums
    solution: Solution

    def later(self, plant: SimulatedPlant, seconds: float = 20.0) -> Sums:
        """What is known behind some more motion."""
        estimator = self.estimator.copy()
        estimator.advance(chunk_of(plant, 7, seconds, 100.0))
        return estimator.sums


@pytest.fixture(scope="module")
def minute() -> Learned:
    model = replace(machine().project.model, terms=(LEAKS,))
    estimator = Estimator(model)
    estimator.history = None
    estimator.advance(chunk_of(leaking(1.0), 1, 60.0, 0.0))
    return Learned(model, estimator, estimator.sums, estimator.solution())


@pytest.mark.long
def test_each_valves_change_of_gain_is_seen(minute: Learned) -> None:
    plant = leaking(1.0)
    gains = (*CHANGES, 0.0)
    valves = [replace(v, gain=v.gain * (1 + g)) for v, g in zip(plant.valves, gains, strict=True)]
    total = minute.later(replace(plant, valves=tuple(valves)))
    wear, sd = wear_since(minute.sums, minute.solution, total)
    assert np.abs(wear.gain - CHANGES).max() < 4e-4
    assert (sd.gain < 1e-4).all()


@pytest.mark.long
def test_a_machine_that_has_not_changed_shows_nothing(minute: Learned) -> None:
    wear, _ = wear_since(minute.sums, minute.solution, minute.later(leaking(1.0)))
    assert np.abs(wear.gain).max() < 3e-4 and np.abs(wear.terms).max() < 0.1


def test_other_oil_is_no_wear(minute: Learned) -> None:
    plant = leaking(1.0)
    softer = plant.constants._replace(beta_pa=0.95 * plant.constants.beta_pa)
    total = minute.later(replace(plant, constants=softer))
    wear, _ = wear_since(minute.sums, minute.solution, total)
    assert np.abs(wear.gain).max() < 5e-4


def test_a_leak_that_is_learned_beside_the_maps_is_seen_to_grow(minute: Learned) -> None:
    wear, sd = wear_since(minute.sums, minute.solution, minute.later(leaking(1.1)))
    assert wear.terms[0] == pytest.approx(0.1, abs=0.01) and sd.terms[0] < 0.01
    assert np.abs(wear.gain).max() < 5e-4


def test_what_was_learned_is_carried_over_whole(minute: Learned) -> None:
    """The same rows fit as well as before, by the unknowns of the changed machine."""
    wear = Wear(np.array(CHANGES), np.array([0.5]))
    carried = carried_over(minute.sums, wear)
    mine = minute.solution.unknowns
    then = changed(minute.solution, wear).unknowns
    rest = misfit(minute.sums, mine)
    assert misfit(carried, then) == pytest.approx(rest, rel=1e-6)
    solution = solve(minute.model, carried)
    assert np.allclose(solution.unknowns[:3], then[:3], rtol=1e-4)
    flows = [b.mean_flow_m3s for b in minute.solution.blocks if b.rows > 100]
    carried_flows = [b.mean_flow_m3s for b in solution.blocks if b.rows > 100]
    edges = [b.edge for b in solution.blocks if b.rows > 100]
    assert np.allclose(carried_flows, flows * (1 + wear.gain[edges]), rtol=1e-4, atol=1e-9)


def test_an_estimator_goes_on_with_what_was_carried_over(minute: Learned) -> None:
    wear = Wear(np.array(CHANGES), np.array([0.5]))
    estimator = minute.estimator.copy()
    estimator.carry_over(wear)
    theirs = solve(minute.model, carried_over(minute.sums, wear)).unknowns
    assert np.allclose(estimator.solution().unknowns, theirs, rtol=1e-6, atol=1e-7)
    whole = minute.estimator.copy()
    whole.carry_over(NOTHING)
    for each in (minute.estimator.copy(), whole):
        each.advance(chunk_of(leaking(1.0), 7, 2.0, 100.0))
        each.carry_over(NOTHING)
        assert each.sums.rows > minute.sums.rows
    assert np.allclose(whole.solution().unknowns, each.solution().unknowns, rtol=1e-7, atol=1e-8)


def test_news_are_what_came_since(minute: Learned) -> None:
    estimator = minute.estimator.copy()
    estimator.advance(chunk_of(leaking(1.0), 7, 5.0, 100.0))
    total = estimator.sums
    rebuilt = minute.sums + (total - minute.sums)
    mine, theirs = rebuilt.normal(), total.normal()
    size = np.sqrt(np.abs(np.diag(theirs.gram)) + 1.0)
    assert np.abs((mine.gram - theirs.gram) / np.outer(size, size)).max() < 1e-12
    assert mine.rows == theirs.rows and rebuilt.cells.tolist() == total.cells.tolist()


def test_the_matrix_need_not_be_dense_to_be_used(minute: Learned) -> None:
    normal = minute.sums.normal()
    x = np.random.default_rng(1).normal(size=(len(normal.right), 3))
    product = normal.gram @ x
    assert np.allclose(minute.sums.times(x), product, rtol=1e-9, atol=1e-9 * np.abs(product).max())
    assert (minute.sums.right == normal.right).all()
