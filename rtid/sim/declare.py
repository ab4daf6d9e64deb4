"""What an honest user would declare of a simulated machine, its `Machine`, and cannot know of it.

Geometry and sensors are exact; the bulk modulus is up to 30 % off, the lag is the data sheet's
1.3 +- 0.2 ms, the maps are unknown above a safe band of 1 V.
"""

from __future__ import annotations

import numpy as np

from rtid.errors import door
from rtid.model import (
    COMMAND,
    POSITION,
    PRESSURE,
    VELOCITY,
    Chamber,
    Edge,
    Grid,
    Lag,
    Machine,
    Signal,
)
from rtid.plain import FloatArray
from rtid.sim.robust import COMMAND_STEP_V, TOP_V
from rtid.sim.run import NAMES, Sensors
from rtid.sim.simulated_plant import AB, EDGES, SimulatedPlant

ENDS = {
    "pa": ("p_supply", "p_a"),
    "at": ("p_a", "p_tank"),
    "pb": ("p_supply", "p_b"),
    "bt": ("p_b", "p_tank"),
    "ab": ("p_a", "p_b"),
}
KINDS = (COMMAND, PRESSURE, PRESSURE, PRESSURE, PRESSURE, POSITION, VELOCITY)
UNITS = ("V", "Pa", "Pa", "Pa", "Pa", "m", "m/s")
RATED_DP_PA = 5e5
DP_STEP_PA = 0.75e6  # of the default grid


def default_grid(p_max_pa: float) -> Grid:
    """Fine along u from the safe band to 3 V, coarse to 10 V; along dp denser towards zero."""
    fine = np.arange(1.0, 3.0, 0.25)
    coarse = np.linspace(3.0, 10.0, 15)
    near_zero = np.array([-0.3e6, 0.0, 0.1e6, 0.25e6, 0.5e6, 0.9e6])
    above = np.arange(near_zero[-1] + DP_STEP_PA, p_max_pa + DP_STEP_PA, DP_STEP_PA)
    return Grid(np.concatenate([fine, coarse]), np.concatenate([near_zero, above]))


def uniform_grid(u_v: tuple[float, float, int], dp_pa: tuple[float, float, int]) -> Grid:
    """Equal blocks: (low, high, number of blocks) along u and along dp."""
    return Grid(*(np.linspace(low, high, count + 1) for low, high, count in (u_v, dp_pa)))


@door
def declared_model(
    plant: SimulatedPlant,
    *,
    grid: Grid | dict[str, Grid] | None = None,
    sensors: Sensors | None = None,
    seed: int = 0,
    safe_band_v: float | None = None,
    lag: Lag | None = None,
    form: str = "integral",
    one_by_one: bool = False,
) -> Machine:
    """The declaration for this machine.

    grid: one for all edges or one per edge name; sensors: as given to `simulate`; seed: of the
    error in the declared bulk modulus; safe_band_v: 1 V, or 0 for valves without a dead band;
    one_by_one: each valve has a command of its own, as `rtid.sim.robust` gives.
    """
    sensors = sensors or Sensors()
    c = plant.constants
    wrong = float(np.random.default_rng([seed, 4]).uniform(0.7, 1.3))
    if safe_band_v is None:
        safe_band_v = 1.0 if min(valve.deadband_v for valve in plant.valves) >= 1.15 else 0.0
    grid = grid or default_grid(1.25 * plant.p_supply_pa)
    grids = grid if isinstance(grid, dict) else dict.fromkeys(EDGES, grid)
    edges = tuple(
        _edge(plant, name, grids[name], safe_band_v, f"u_{name}" if one_by_one else "u")
        for name in plant.edges
    )
    signals = _signals(sensors)
    return Machine(
        signals=(*_valve_commands(edges), *signals[1:]) if one_by_one else signals,
        chambers=(
            Chamber("a", "p_a", c.area_a_m2, 1, c.v0_a_m3),
            Chamber("b", "p_b", c.area_b_m2, -1, c.v0_b_m3 + c.area_b_m2 * c.stroke_m),
        ),
        edges=edges,
        position="x",
        beta_nominal_pa=plant.beta_pa * wrong,
        beta_bounds_pa=(200e6, 1600e6),
        lag=lag or Lag(1.3e-3, 0.2e-3),
        form=form,
    )


def _valve_commands(edges: tuple[Edge, ...]) -> tuple[Signal, ...]:
    """The commands of single valves, 0 to 10 V in the steps of their frame."""
    return tuple(Signal(e.command, COMMAND, "V", 0.0, COMMAND_STEP_V, 0.0, TOP_V) for e in edges)


def _edge(plant: SimulatedPlant, name: str, grid: Grid, safe_band_v: float, command: str) -> Edge:
    """The edge with the data sheet's rated flow, the same for every valve of one machine."""
    source, sink = ENDS[name]
    gain = float(np.mean([valve.gain for valve in plant.valves[:AB]]))
    rated_q_m3s = gain * 4.0 * float(np.sqrt(RATED_DP_PA))
    direction = plant.directions[EDGES.index(name)]
    return Edge(name, source, sink, command, direction, grid, safe_band_v, rated_q_m3s, RATED_DP_PA)


def _signals(sensors: Sensors) -> tuple[Signal, ...]:
    """The signals in the order of the samples, with their noise and range."""
    p, x, v, u = sensors.p_range_pa, sensors.x_range_m, sensors.v_range_mps, sensors.u_range_v
    low: FloatArray = np.array([-u / 2, -p, -p, -p, -p, -x, -v / 2])
    high: FloatArray = np.array([u / 2, p, p, p, p, x, v / 2])
    columns = zip(
        NAMES, KINDS, UNITS, sensors.noise(), sensors.resolution(), low, high, strict=True
    )
    return tuple(
        Signal(name, kind, unit, float(noise), float(step), float(a), float(b))
        for name, kind, unit, noise, step, a, b in columns
    )
