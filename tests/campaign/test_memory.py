"""What a very fine grid costs in memory: 100 x 80 blocks per edge, 20 candidates, 5 folds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.estimator.estimator import Estimator
from rtid.model import Grid, Machine, Term, Upkeep
from rtid.sim.declare import declared_model
from rtid.sim.demand import moves
from rtid.sim.random_plants import draw
from tests.campaign.report import leave
from tests.estimator.aging import pieces

SEED = 8
SHAPES = ("linear", "root", "hinge")


def fine_model(recent_blocks: int) -> Machine:
    """The machine of the tracking tests with the finest grid that is asked for."""
    grid = Grid(np.linspace(0, 10, 101), np.linspace(-1e6, 9e6, 81))
    weights = [(("p_a", 1.0), ("p_b", -0.05 * k)) for k in range(20)]
    signs = (("a", -1), ("b", 1))
    terms = tuple(
        Term(f"leak {k}", w, signs, 1e-11, -1e5 * k, SHAPES[k % 3]) for k, w in enumerate(weights)
    )
    model = declared_model(draw(SEED), seed=SEED, grid=grid)
    upkeep = Upkeep(every_s=10.0, folds=5)
    return replace(model, terms=terms, upkeep=upkeep, recent_blocks=recent_blocks)


def megabytes(estimator: Estimator) -> float:
    """State and folds."""
    parts = [(f.shared, f.blocks, f.pairs, f.tiles) for f in estimator.folds]
    folds = sum(array.nbytes for arrays in parts for array in arrays)
    return (estimator.state.memory.nbytes + folds) / 1e6


def learned(recent_blocks: int, seconds: float) -> Estimator:
    """Random point-to-point moves, in pieces of 10 s."""
    model = fine_model(recent_blocks)
    estimator = Estimator(model)
    for _, chunk in pieces(draw(SEED), model, lambda t: 1.0, seconds, motion=moves):
        estimator.advance(chunk)
    return estimator


def test_fewer_recent_blocks_take_less_memory() -> None:
    small, large = (megabytes(learned(n, 20.0)) for n in (8, 64))
    print(f"after 20 s: {small:.0f} MB with 8 recent blocks, {large:.0f} MB with 64")
    assert small < 0.6 * large


@pytest.mark.campaign
def test_an_hour() -> None:
    estimator = learned(8, 3600.0)
    size = megabytes(estimator)
    leave(
        "memory of 100 x 80 blocks per edge, 20 candidates, 5 folds, recent_blocks = 8",
        f"{size:.0f} MB after an hour of moves, {len(estimator.sums.blocks)} blocks visited",
        "150 MB",
        "one machine",
    )
    assert size <= 150
