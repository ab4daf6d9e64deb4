"""An adaptive robust controller of the boom (Liu and Yao), adaptation off.

The product's neighbour: its law is `kernels.control_law`, every valve has a command of its own, and
`working_modes` says which valves carry them.  What the controller knows is all that differs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from firmware_bridge.lookup import Table
from rtid.kernels.control_law import Mechanics, RobustLaw, wanted_flows
from rtid.plain import FloatArray
from rtid.sim.closed_loop import LOAD, P_SUPPLY, P_TANK, PlainMachine, advance, new_spools, quantise
from rtid.sim.compiled import compiled
from rtid.sim.demand import DT_S
from rtid.sim.dynamics import flows
from rtid.sim.extra_flows import SUPPLY, extra_valve_flows
from rtid.sim.extra_physics import parts_of
from rtid.sim.run import at_rest, machine_of
from rtid.sim.schedule import schedule
from rtid.sim.sensing import P_A, P_B, P_S, P_T, Sensors, U, V, X
from rtid.sim.simulated_plant import EDGES, PA, PB, SimulatedPlant, flow_gain
from rtid.sim.working_modes import Maps, commands, regenerates

GAIN_1PS = 16.0  # of the paper
OFF_GAIN_1PS = 80.0  # of the pressure of B: a map that is 10 % wrong must not let it cavitate
OFF_SIDE_PA = 1.5e6
COMMAND_STEP_V, TOP_V = 0.01, 10.0  # of the command frame
SUBSTEPS = 10
W_V, S = np.linspace(0.0, TOP_V, 1001), np.sqrt(np.linspace(0.0, 10e6, 401))

Flow = Callable[[str, FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class Knowledge:
    """What the controller knows besides the machine's constants.

    leak_m3spa: coefficient of the internal leakage that it makes up for; may_regenerate: whether it
    uses the cross-port valve at all.
    """

    maps: Maps
    leak_m3spa: float = 0.0
    may_regenerate: bool = True


@dataclass(frozen=True)
class Tracked:
    """One run of n samples at 1 kHz.

    error_m (n,): true position less its reference; signals (n, 7): what the sensors said, columns
    as `sensing.NAMES`; commands_v (n, 5) of `plant.EDGES`; true_pa (n, 2): P_A and P_B; energy_j:
    from the supply.
    """

    error_m: FloatArray
    signals: FloatArray = field(repr=False)
    commands_v: FloatArray = field(repr=False)
    true_pa: FloatArray = field(repr=False)
    energy_j: float

    @property
    def rms_m(self) -> float:
        """Root mean square of the tracking error."""
        return float(np.sqrt(np.mean(self.error_m**2)))

    @property
    def largest_m(self) -> float:
        """Largest tracking error."""
        return float(np.abs(self.error_m).max())


def sampled(flow: Flow) -> Maps:
    """A map that is known everywhere, on a fine lattice; flow(edge, w, dp) in m3/s."""
    w, dp = np.meshgrid(W_V, S**2, indexing="ij")
    return _maps((W_V, S, flow(edge, w, dp)) for edge in EDGES)


def received(tables: Sequence[Table]) -> Maps:
    """Maps as the bridge brought them, in the order of EDGES, opening with w > 0."""
    return _maps((t.w_v.astype(float), t.s.astype(float), t.flow_m3s) for t in tables)


def _maps(parts: Any) -> Maps:
    """The controller's arrays; a flow that falls with the command is held, to have an inverse."""
    w, s, flow = zip(*parts, strict=True)
    rising = (np.ascontiguousarray(np.maximum.accumulate(q, axis=0)) for q in flow)
    return Maps(tuple(w), tuple(s), tuple(rising))


@compiled
def drawn_w(
    m: PlainMachine, e: Any, gains: FloatArray, drive: FloatArray, y: FloatArray, q: FloatArray
) -> float:
    """Power that the supply gives for the gains (5,), W; q (5,) becomes the flows, m3/s."""
    if e is None:
        flows(m.c, m.valves, gains, y, drive[P_SUPPLY], drive[P_TANK], q)
        return drive[P_SUPPLY] * (q[PA] + q[PB])
    extra_valve_flows(m.c, e, m.valves, gains, drive[P_SUPPLY:], y, q)
    power: float = y[SUPPLY] * (q[PA] + q[PB])
    return power


@compiled
def track(
    m: PlainMachine,
    e: Any,
    law: RobustLaw,
    maps: Maps,
    may_regenerate: bool,
    ref: FloatArray,
    drive: FloatArray,
    noise: FloatArray,
    steps: FloatArray,
    y: FloatArray,
    record: FloatArray,
) -> float:
    """Run the loop; ref (n, 4), drive (n + 1, 8), noise (n, 7), y is changed in place.

    e: as of `loop.run_loop`.  record (n, 15), SI, is filled: error, P_A, P_B, seven measured
    signals, five commands.  Returns the energy from the supply, J.
    """
    half_s = 0.5 * DT_S / SUBSTEPS
    spools = new_spools(e, m.lag_s, half_s, 1)
    decay = math.exp(-half_s / m.lag_s) if m.lag_s > 0.0 else 0.0
    gains, q, energy_j, regenerate = np.empty(5), np.empty(5), 0.0, False
    for i in range(len(ref)):
        seen, w = record[i, 3:10], spools.commands[1]
        seen[U], seen[P_S], seen[P_T] = 0.0, drive[i, P_SUPPLY], drive[i, P_TANK]
        seen[P_A], seen[P_B], seen[X], seen[V] = y[0], y[1], y[2], y[3]
        for column in range(7):
            seen[column] = quantise(seen[column] + noise[i, column], steps[column])
        q_a, q_b = wanted_flows(law, seen[X], seen[V], seen[P_A], seen[P_B], ref[i])
        regenerate = may_regenerate and regenerates(seen, regenerate)
        commands(maps, seen, q_a, q_b, regenerate, w)
        for edge in range(5):
            w[edge] = quantise(w[edge], COMMAND_STEP_V)
            gains[edge] = flow_gain(m.valves[edge], spools.w[edge])
        record[i, 0], record[i, 1], record[i, 2] = y[2] - ref[i, 0], y[0], y[1]
        for j in range(5):
            record[i, 10 + j] = w[j]
        energy_j += drawn_w(m, e, gains, drive[i], y, q) * DT_S
        advance(m, e, gains, drive[i : i + 2], decay, 0.0, DT_S / SUBSTEPS, spools, y, SUBSTEPS)
    return energy_j


def run(plant: SimulatedPlant, known: Knowledge, reference: FloatArray, seed: int = 0) -> Tracked:
    """Follow a reference (n, 4), SI; the same seed gives the same sensor noise.

    Of hidden physics only flows act here, not what changes commands or sensors.
    """
    n, sensors = len(reference), Sensors()
    noise = np.random.default_rng([seed, 11]).standard_normal((n, 7)) * sensors.noise()
    drive = np.zeros((n + 1, 8))
    drive[:, P_SUPPLY], drive[:, P_TANK], drive[:, LOAD] = plant.p_supply_pa, plant.p_tank_pa, 0.0
    drive[:, LOAD + 1 :] = schedule(plant.extra, n + 1, DT_S, np.random.default_rng([seed, 6]))
    lead_s = plant.lag_s + 0.5 * DT_S
    known_of = Mechanics(*plant.constants[:-1])
    law = RobustLaw(known_of, GAIN_1PS, OFF_GAIN_1PS, OFF_SIDE_PA, lead_s, known.leak_m3spa)
    y = at_rest(plant, drive[0], float(reference[0, 0]), OFF_SIDE_PA)
    record = np.empty((n, 15))
    energy_j = track(
        machine_of(plant), parts_of(plant.extra), law, known.maps, known.may_regenerate, reference,
        drive, noise, sensors.resolution(), y, record,
    )  # fmt: skip
    return Tracked(record[:, 0], record[:, 3:10], record[:, 10:], record[:, 1:3], float(energy_j))
