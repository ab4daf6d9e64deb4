"""A machine that changes: the map's error against the truth over time, beside plain forgetting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from rtid.estimator.estimator import Estimator
from rtid.estimator.published import publish
from rtid.estimator.sums import Sums
from rtid.model import Grid, Machine, Upkeep
from rtid.plain import FloatArray, IntArray
from rtid.sim.declare import declared_model, default_grid
from rtid.sim.demand import Motion, rich
from rtid.sim.random_plants import draw
from rtid.sim.simulated_plant import SimulatedPlant
from tests.campaign.report import leave
from tests.estimator.aging import map_error, pieces, points_of, timid

UPKEEP = Upkeep(every_s=5.0, forget_s=60.0, shared_forget_s=300.0, innovation_sd=8.0)
SEED = 8

Gain = Callable[[float], float]


class PlainForgetting(Estimator):
    """Everything fades alike, excited or not: the exponential window of the textbook."""

    def _fade(self, news: Sums, changed: IntArray) -> None:
        upkeep = self.model.upkeep
        keep = float(np.exp(-upkeep.every_s / upkeep.forget_s))
        self.folds = [_times(fold, keep) for fold in self.folds]


def _times(sums: Sums, keep: float) -> Sums:
    blocks = sums.blocks.copy()
    for name in ("gram", "shared"):
        blocks[name] *= keep
    small = {n: getattr(sums, n) * keep for n in ("shared", "tiles", "noise", "rows")}
    return replace(sums, blocks=blocks, **small)


def machine() -> tuple[SimulatedPlant, Machine]:
    """A random plant with a grid of some hundred visited blocks."""
    plant = draw(SEED)
    fine = default_grid(1.25 * plant.p_supply_pa)
    return plant, declared_model(plant, seed=SEED, grid=Grid(fine.u_v[::2], fine.dp_pa[::2]))


@dataclass(frozen=True)
class Track:
    """Rms error of the published map at test points, shares of the largest flow, over time."""

    t_s: FloatArray
    rms: FloatArray

    def at(self, t_s: float) -> float:
        return float(self.rms[np.searchsorted(self.t_s, t_s)])


def follow(
    kind: type[Estimator], upkeep: Upkeep, gain: Gain, plan: list[tuple[Motion, float]]
) -> Track:
    """Learn along the plan [(motion, seconds)], look at the map every 30 s."""
    plant, model = machine()
    estimator, points = kind(replace(model, upkeep=upkeep)), points_of(plant, model)
    start_s, found = 0.0, []
    for motion, seconds in plan:
        for t_s, chunk in pieces(plant, model, gain, seconds, start_s, motion):
            estimator.advance(chunk)
            if t_s % 30 == 0:
                error = map_error(publish(estimator.solution()), points, gain(t_s))
                found.append((t_s, float(np.sqrt(np.nanmean(error**2)))))
        start_s += seconds
    t, rms = np.array(found).T
    return Track(t, rms)


def beside(gain: Gain, plan: list[tuple[Motion, float]]) -> dict[str, Track]:
    """With forgetting by news, with plain forgetting, and without any."""
    kinds = {"news": (Estimator, UPKEEP), "plain": (PlainForgetting, UPKEEP)}
    kinds["none"] = (Estimator, Upkeep())
    return {name: follow(kind, upkeep, gain, plan) for name, (kind, upkeep) in kinds.items()}


def percent(tracks: dict[str, Track], t_s: float) -> str:
    return ", ".join(f"{name} {100 * track.at(t_s):.2f} %" for name, track in tracks.items())


@pytest.mark.campaign
def test_a_step_of_the_gain_is_learned_again() -> None:
    """Shorter than below, and without the other two."""
    track = follow(Estimator, UPKEEP, lambda t: 1.0 if t <= 90 else 0.95, [(rich, 210.0)])
    print(f"map error {100 * track.at(90):.2f} % before; then {np.round(100 * track.rms[3:], 2)} %")
    assert track.at(90) < 0.005
    assert track.at(120) < 0.02
    assert track.at(210) < 0.01


@pytest.mark.campaign
def test_drift() -> None:
    """10 % in 10 minutes."""
    tracks = beside(lambda t: 1 - 0.1 * float(np.clip((t - 120) / 600, 0, 1)), [(rich, 720.0)])
    worst = ", ".join(f"{k} {100 * t.rms[t.t_s > 180].max():.2f} %" for k, t in tracks.items())
    text = f"at the end: {percent(tracks, 720.0)}; worst on the way: {worst}"
    leave("Valve gains drift 10 % in 10 min: rms map error", text, "below plain", "1 plant")
    assert tracks["news"].at(720) < tracks["plain"].at(720)
    assert tracks["news"].rms[tracks["news"].t_s > 180].max() < 0.01


@pytest.mark.campaign
def test_step() -> None:
    """All gains fall by 5 % after 200 s."""
    tracks = beside(lambda t: 1.0 if t <= 200 else 0.95, [(rich, 420.0)])
    text = f"after 100 s: {percent(tracks, 300.0)}; after 220 s: {percent(tracks, 420.0)}"
    leave("Valve gains step by 5 %: rms map error", text, "below plain", "1 plant")
    assert tracks["news"].at(420) < 0.01
    assert tracks["news"].at(420) < tracks["plain"].at(420)


@pytest.mark.campaign
def test_an_hour_elsewhere() -> None:
    """Two minutes of rich motion, then an hour in few blocks: what happens to the others."""
    tracks = beside(lambda t: 1.0, [(rich, 120.0), (timid, 3600.0)])
    text = f"before: {percent(tracks, 120.0)}; after: {percent(tracks, 3720.0)}"
    leave("Blocks unvisited for an hour: rms map error", text, "below plain", "1 plant")
    assert tracks["news"].at(3720) < tracks["plain"].at(3720)
