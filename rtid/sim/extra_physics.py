"""Physics that a simulated machine may have besides its declared equations: the numbers alone.

Everything is zero for the plain machine.  A pair belongs to the chambers (A, B), a five to the
edges in the order of `plant.EDGES`.  `rtid.sim.hidden` sets the numbers; the equations are in
`rtid.sim.extra_flows`, `spool`, `schedule` and `sensing`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

Pair = tuple[float, float]
Five = tuple[float, float, float, float, float]
NO_PAIR: Pair = (0.0, 0.0)
NO_FIVE: Five = (0.0, 0.0, 0.0, 0.0, 0.0)


class Extra(NamedTuple):
    """Coefficients of all extra physics, SI."""

    # flows out of, into and between the chambers
    internal_laminar: float = 0.0  # m3/s/Pa
    internal_turbulent: float = 0.0  # m3/s/sqrt(Pa)
    external_laminar: Pair = NO_PAIR
    external_turbulent: Pair = NO_PAIR
    groove: float = 0.0  # m3/s/Pa at its middle
    groove_one_way: float = 0.0  # the same, open while extending only
    relief: Pair = NO_PAIR  # m3/s/Pa
    relief_open_pa: Pair = NO_PAIR
    makeup: Pair = NO_PAIR  # m3/s/Pa
    makeup_open_pa: Pair = NO_PAIR
    burst_m3s: float = 0.0  # into chamber A
    # metering edges
    seat: Five = NO_FIVE  # m3/s/sqrt(Pa)
    compensated: Five = NO_FIVE  # 0: orifice, 1: flow does not depend on dp
    gain_drift: float = 0.0  # relative change of all gains over the record
    gain_swing: float = 0.0  # relative amplitude
    # storage
    air_share: float = 0.0  # of the volume at atmospheric pressure
    stiffening: float = 0.0  # of the oil's modulus, as a share of it per Pa
    released: Pair = NO_PAIR  # share of the volume that boils out of the oil below `release_pa`
    release_pa: Pair = NO_PAIR
    dead_volume_m3: Pair = NO_PAIR
    hose_m3ppa: Pair = NO_PAIR
    line_m: Pair = NO_PAIR  # length of the hose between valve and chamber
    sensor_at_valve: float = 0.0  # 1: the pressure sensors sit at the valves' end of the hose
    # supply
    sag_pasm3: float = 0.0  # droop of the pump: pressure per flow
    sag_measured: float = 0.0  # 1: the supply sensor sees it
    branch_kgpm4: float = 0.0  # inertance of the supply branch of the edge pa
    # from the command to the spools
    delay_s: float = 0.0
    play_v: float = 0.0  # full width
    stick_v: float = 0.0  # command that sets a stuck pilot free
    spool_radps: float = 0.0  # natural frequency; 0: first order
    spool_damping: float = 0.0
    spool_lag_s: float = 0.0  # a lag besides the spool's own
    spool_rate_vps: float = 0.0  # the fastest that it moves; 0: as fast as its lag has it
    spool_order: float = 0.0  # 3: limited, 2: frequency and damping, 1: two lags, 0: plain
    # sensors
    pressure_lag_s: Pair = NO_PAIR
    pressure_bias_pa: Pair = NO_PAIR
    position_delay_s: float = 0.0
    velocity_scale: float = 0.0  # relative


NONE = Extra()
EDGES = ("pa", "at", "pb", "bt", "ab")  # as `plant.EDGES`, which knows this file
WHOLE = [name for name, value in NONE._asdict().items() if value == 0.0]
CHAMBER = [name for name, value in NONE._asdict().items() if value == NO_PAIR]
EDGE = [name for name, value in NONE._asdict().items() if value == NO_FIVE]


class Parts(NamedTuple):
    """The numbers as the kernels take them: records of floats, by reference.

    whole: the machine's own and, as seat_pa, seat_at ..., those of its edges; a, b: the chambers'.
    """

    whole: Any
    a: Any
    b: Any


def parts_of(e: Extra) -> Parts | None:
    """The numbers for the kernels; None if all are zero."""
    if e == NONE:
        return None
    whole = {name: getattr(e, name) for name in WHOLE}
    for name in EDGE:
        whole |= {f"{name}_{edge}": getattr(e, name)[i] for i, edge in enumerate(EDGES)}
    a, b = ({name: getattr(e, name)[i] for name in CHAMBER} for i in range(2))
    return Parts(_record(whole), _record(a), _record(b))


def _record(numbers: dict[str, float]) -> np.record:
    table = np.zeros(1, [(name, float) for name in numbers]).view(np.recarray)
    table[0] = tuple(numbers.values())
    record: np.record = table[0]
    return record


class Planted(NamedTuple):
    """One effect hidden in a plant: its name in `hidden.HIDDEN`, its place, its size there."""

    name: str
    where: str
    strength: float
