"""Records that are hard for a controller: what makes one tick long must be among them."""

from __future__ import annotations

from functools import cache

import numpy as np

from rtid.mcu.emulated import Record
from rtid.mcu.valve import one_valve
from rtid.model import Grid, Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant

CELLS = {24: (4, 3), 96: (8, 6)}  # blocks of both edges: cells along u and dp of each
RANGE_V, RANGE_PA = (1.0, 10.0), (-0.5e6, 9.5e6)
NAMES = ("sweep", "rich", "chatter", "standstill", "restarts")
ANYWHERE = "anywhere"  # every millisecond another block, as no valve can: for the bound


@cache
def valve(blocks: int) -> Machine:
    """Chamber a of the simulated machine on a controller's grid of so many blocks."""
    nu, nd = CELLS[blocks]
    grid = Grid(np.linspace(*RANGE_V, nu + 1), np.linspace(*RANGE_PA, nd + 1))
    whole = declared_model(SimulatedPlant(), grid=grid)
    return one_valve(whole, whole.chambers[0].name)


@cache
def driven(motion: str, duration_s: float) -> Record:
    """A simulated record with the sensors' noise."""
    run = simulate(SimulatedPlant(), motion, seed=3, duration_s=duration_s)
    model, taken = valve(24), run.samples
    columns = [taken.names.index(signal.name) for signal in model.signals]
    return Record(
        taken.t_us - taken.t_us[0], taken.values[:, columns], (taken.flags & 1).astype(float)
    )


def repeated(duration_s: float) -> Record:
    """A minute of motion over and over, from the second time on with noise added."""
    base, model, times = driven("rich", 60.0), valve(24), int(duration_s / 60.0)
    rng, n = np.random.default_rng(0), len(base.values)
    noise = np.array([signal.noise for signal in model.signals])
    parts = [base.values]
    parts += [base.values + noise * rng.normal(size=base.values.shape) for _ in range(1, times)]
    low, high = (np.array([getattr(s, e) for s in model.signals]) for e in ("minimum", "maximum"))
    flags = np.ones(n * times)
    flags[n::n] = 3.0  # a gap where one ends
    return Record(1000 * np.arange(n * times), np.clip(np.concatenate(parts), low, high), flags)


def record(name: str, blocks: int, duration_s: float = 20.0) -> Record:
    """One of NAMES or ANYWHERE, for the machine with so many blocks."""
    base = driven("rich" if name == "rich" else "sweep", duration_s)
    values, flags, t_us = base.values.copy(), base.flags.copy(), base.t_us.copy()
    if name == "chatter":
        _wander(values, blocks, 0.3)
    elif name == ANYWHERE:
        _wander(values, blocks, 3.0)
    elif name == "standstill":
        values[len(values) // 3 :] = values[len(values) // 3]
        values[len(values) // 3 :, _column("u")] = 0.0
    elif name == "restarts":
        flags[::777] += 2  # samples were lost before
        values[5::3331] = np.nan
        t_us[len(t_us) // 2 :] -= t_us[len(t_us) // 2] - 1000  # the clock began anew
    return Record(t_us, values, flags)


def _column(name: str) -> int:
    return [signal.name for signal in valve(24).signals].index(name)


def _wander(values: FloatArray, blocks: int, widths: float) -> None:
    """Command and pressure go about a corner of four blocks, so many widths of a block far."""
    rng = np.random.default_rng(5)
    model, n = valve(blocks), len(values)
    edge = model.edges[0]
    u, dp = (border[len(border) // 2] for border in (edge.grid.u_v, edge.grid.dp_pa))
    du, dd = edge.grid.u_v[1] - edge.grid.u_v[0], edge.grid.dp_pa[1] - edge.grid.dp_pa[0]
    fast = rng.uniform(-1.0, 1.0, (n, 2)) * widths
    values[:, _column(edge.command)] = edge.direction * (u + du * fast[:, 0])
    source, sink = _column(edge.source), _column(edge.sink)
    values[:, sink] = values[:, source] - (dp + dd * fast[:, 1])
