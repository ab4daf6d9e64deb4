"""What the benchmarks work on: a simulated record of the default machine and its models."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.samples import Samples
from rtid.estimator.state import State, build
from rtid.kernels import housekeeping
from rtid.model import Grid, Machine
from rtid.sim.declare import declared_model, uniform_grid
from rtid.sim.run import Run, simulate
from rtid.sim.simulated_plant import SimulatedPlant

FloatArray = NDArray[np.float64]

SECONDS = 60.0
RANGE_V, RANGE_PA = (1.0, 10.0), (-0.5e6, 9.5e6)
COARSE = (10, 8)


@cache
def run() -> Run:
    """The swept sine at 1 kHz with sensor noise."""
    return simulate(SimulatedPlant(), "sweep", seed=1, duration_s=SECONDS)


def record() -> Samples:
    """Return the samples of the run."""
    return run().samples


def model(blocks: tuple[int, int] = (30, 20), span: bool = False) -> Machine:
    """Two chambers, four edges, each with a uniform grid of blocks (along u, along dp).

    With `span` the blocks have the size of the 10 x 8 grid, and more blocks reach further.
    """
    (low_v, high_v), (low_pa, high_pa) = RANGE_V, RANGE_PA
    if span:
        high_v = low_v + (high_v - low_v) * blocks[0] / COARSE[0]
        high_pa = low_pa + (high_pa - low_pa) * blocks[1] / COARSE[1]
    return declared_model(
        SimulatedPlant(),
        grid=uniform_grid((low_v, high_v, blocks[0]), (low_pa, high_pa, blocks[1])),
    )


def one_chamber(full: Machine) -> Machine:
    """Chamber A and its two edges alone: one shared parameter."""
    edges = tuple(e for e in full.edges if "p_a" in (e.source, e.sink))
    return replace(full, chambers=full.chambers[:1], edges=edges)


def one_block(full: Machine) -> Machine:
    """Chamber A, one edge that is always open, one block: 7 parameters, filter (10), all rows."""
    grid = Grid(np.array([-20.0, 20.0]), np.array([-3e7, 3e7]))
    edge = replace(full.edges[0], grid=grid, safe_band_v=-np.inf)
    every_row = replace(full.filter, rows_per_s=1e3)
    return replace(one_chamber(full), edges=(edge,), form="carry", filter=every_row)


def chunk(samples: Samples) -> FloatArray:
    """Rows [t_s, flags, values...] as the kernel takes them."""
    t_s = samples.t_us * 1e-6
    return np.column_stack([t_s, samples.flags, samples.values])


def empty(of: Machine, shared: int | None = None) -> State:
    """Fresh state; `shared` sets the number of shared columns, those without an effect stay 0."""
    state = build(of)
    if shared is not None:
        state.engine[0]["n_shared"] = shared
        housekeeping.clear(state.engine, state.cells)
    return state


def warmed(of: Machine, data: FloatArray, shared: int | None = None) -> State:
    """State that has seen the data once: every block that data visits has its slot."""
    state = empty(of, shared)
    state.advance(data)
    return state
