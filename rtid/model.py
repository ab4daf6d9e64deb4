"""What the user declares about the machine: chambers, metering edges, grids, noise and priors.

Per chamber c the pressure equation (14) of IMECE2005-79420, all terms in m3/s, is

    s_c A_c v = - V_c(x) dP_c/dt * theta_beta_c + sum over open edges of sigma * Q_edge(u, dp)

with V_c(x) = V0_c + s_c A_c x, theta_beta_c = 1 / beta_c, and sigma = +1 for an edge that feeds
the chamber, -1 for one that drains it.

A plant of the general form (1), xdot = phi(x)' theta + f(u, x), is the same with other names: a
chamber without pressure whose `area_m2` is 1, shared terms for phi, an edge for f.  Everything here
is SI and immutable; the project file (`rtid.project`) is turned into one `Machine`, and nothing
below this module knows a file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rtid.plain import FloatArray

COMMAND, PRESSURE, POSITION, VELOCITY = "command", "pressure", "position", "velocity"
SENSORS = (POSITION, PRESSURE, VELOCITY)
MODE = "mode"  # kind of the signal that carries the number of the working mode
OTHER = "other"  # kind of a signal of any other quantity: a force, a temperature
TAYLOR, LAPPED, BLENDED, PROPORTIONAL = BASES = "taylor", "lapped", "blended", "proportional"
BOTH, COMMAND_ONLY, DROP_ONLY = "both", "command", "drop"
MOST_MODE = 62  # a set of modes is kept as bits of one integer
FLOW, VOLUME = "m3/s", "m3"  # units of a machine with pressures
AHEAD = "mean ahead of "  # before a signal's name: its mean up to the next mean
NONE = ""  # in place of a signal's name: a quantity that is always zero


@dataclass(frozen=True)
class Signal:
    """One column of the samples: its role, sensor noise (1 sigma, SI unit) and resolution (SI).

    is_ahead: a measurement of which a sample carries the mean up to the next sample.
    """

    name: str
    kind: str  # COMMAND, PRESSURE, POSITION or VELOCITY
    unit: str = ""  # SI unit (or V, A, PWM for a command)
    noise: float = 0.0
    resolution: float = 0.0
    minimum: float = -np.inf  # a value outside [minimum, maximum] is refused: gate "range"
    maximum: float = np.inf
    is_ahead: bool = False

    @property
    def is_held(self) -> bool:
        """True where a value acts up to the next one, and is not linear in between."""
        return self.kind in (COMMAND, MODE) or self.is_ahead


@dataclass(frozen=True)
class Grid:
    """Block borders of one flow map: u_v (nu + 1,), dp_pa (nd + 1,), both strictly increasing."""

    u_v: FloatArray
    dp_pa: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Number of blocks along u and along dp."""
        return len(self.u_v) - 1, len(self.dp_pa) - 1


@dataclass(frozen=True)
class Chamber:
    """One pressure equation: `pressure` names its signal, V(x) = v0_m3 + sign * area_m2 * x.

    Of a motor that goes round for ever x is its angle in rad, area_m2 its displacement in m3/rad,
    and with is_constant V = v0_m3: what comes in on one side goes out on the other.

    Without a pressure (NONE) it is xdot = ..., times area_m2.  disturbance: intensity of unmodelled
    flow, m3/s per sqrt(Hz), a white noise that the rows are weighed for.  unit: of the equation.
    behind_s: a lag behind the maps, whose noise stands behind it too; see
    `rtid.effects.laws.response`.  ports: of a rate that a pump drives, the pressure signals behind
    its ports, each with the sign of the command that puts it under pressure.
    """

    name: str
    pressure: str
    area_m2: float
    sign: int  # +1: the volume grows with x, -1: it shrinks
    v0_m3: float
    disturbance: float = 0.0
    unit: str = FLOW
    behind_s: float = 0.0
    ports: tuple[tuple[str, int], ...] = ()
    is_constant: bool = False

    @property
    def growth_m2(self) -> float:
        """dV/dx, signed, m2."""
        return 0.0 if self.is_constant else self.sign * self.area_m2

    def volume(self, x_m: FloatArray) -> FloatArray:
        """V (...) in m3 at positions x (...) in m."""
        return self.v0_m3 + self.growth_m2 * x_m


@dataclass(frozen=True)
class Edge:
    """A metering edge with its own map Q(u, dp), dp = p_source - p_sink, Q > 0 from source to sink.

    `source` and `sink` name pressure signals.  The edge opens with w = direction * u of the signal
    `command`; for w <= safe_band_v it passes nothing (prior knowledge, below 0 where an underlap
    stands open at rest, can be -inf to switch off).
    The grid is in terms of w.  rated_* give the size of the flow for scaling and first weights.

    basis: TAYLOR, eq. (6), LAPPED, local cosines under the windows of (12), BLENDED, Taylor terms
    under the squares of these windows, or PROPORTIONAL, D w with a D per block.  terms: BOTH, or
    DROP_ONLY, eq. (15), one function of dp per interval of w, or COMMAND_ONLY.  modes: working
    modes in which it may open, all when empty; in the others its command is zero. signs: (chamber,
    +1 or -1) pairs, where the ends' names do not tell which chambers it feeds and drains. shares:
    an edge before it, whose map it has as well: one map of several commands, such as the rotors of
    one aircraft.
    """

    name: str
    source: str
    sink: str
    command: str
    direction: int
    grid: Grid
    safe_band_v: float
    rated_q_m3s: float
    rated_dp_pa: float
    basis: str = TAYLOR
    terms: str = BOTH
    modes: tuple[int, ...] = ()
    signs: tuple[tuple[str, int], ...] = ()
    shares: str = NONE

    @property
    def shut_up_to_v(self) -> float:
        """Command up to which it passes next to nothing: its band, 0 where none is declared."""
        return self.safe_band_v if np.isfinite(self.safe_band_v) else 0.0

    def sign(self, chamber: Chamber) -> int:
        """+1 where the edge feeds the chamber, -1 where it drains it, else 0."""
        if self.signs:
            return dict(self.signs).get(chamber.name, 0)
        return (self.sink == chamber.pressure) - int(self.source == chamber.pressure)


@dataclass(frozen=True)
class Axes:
    """What the map of an edge is over, and the units in which the model has these quantities.

    over: the second quantity of a plant without pressures, NONE of a map of the command alone; None
    of a pressure drop.  second: its unit, "1" where there is none.
    """

    command: str = "V"
    second: str = "Pa"
    over: str | None = None


SHAPES = ("linear", "root", "hinge", "inverse")


@dataclass(frozen=True)
class Term:
    """A shared flow theta * scale * f(z) or, with `rate`, - theta * scale * V df(z)/dt.

    z = sum of weights * signal + constant, linear between samples; weights: (signal, weight) pairs;
    signs: (chamber, +1 or -1) pairs.  f(z) by `shape`: z, sign(z) sqrt|z|, max(0, z) or -1 / z.
    volume: the chamber whose V(x) multiplies a rate, NONE for 1.  sd: theta = 1 +- sd is known
    beforehand, and counts as one row more.

    A laminar internal leakage has weights p_a: 1, p_b: -1, signs a: -1, b: +1, and a scale in
    m3/s/Pa near the coefficient that is expected; a relief valve is a hinge with the constant
    -p_open; entrained air is the rate of -1 / p.
    """

    name: str
    weights: tuple[tuple[str, float], ...]
    signs: tuple[tuple[str, int], ...]
    scale: float
    constant: float = 0.0
    shape: str = "linear"
    rate: bool = False
    volume: str = NONE
    sd: float = np.inf


@dataclass(frozen=True)
class Lag:
    """First-order lag of the spool behind the command: nominal value and tolerance, seconds."""

    nominal_s: float = 0.0
    tolerance_s: float = 0.0


@dataclass(frozen=True)
class Filter:
    """H_f(s) = wn^2 / (s^2 + 2 zeta wn s + wn^2), eq. (10), and its row rate."""

    wn_rad_s: float = 2 * np.pi * 10
    zeta: float = 0.8
    rows_per_s: float = 50.0


@dataclass(frozen=True)
class Gates:
    """Limits of the gates; see `rtid.estimator` for the codes."""

    condition_limit: float = 1e8
    max_gap_s: float = 0.05  # a longer step between samples restarts the integrals
    recovery_s: float = 0.0  # nothing is learned for so long after a gap or a refused sample
    hysteresis: float = 0.05  # share of a block's width that the working point must leave it by
    min_rows: int = 20  # rows that a block needs before it can become valid
    max_sd_share: float = 0.001  # of the edge's largest flow: known worse than this is not valid
    max_surprise: float = 3.0  # mean squared innovation of the map held: above it is invalid
    stale_s: float = np.inf  # a block that was not visited for longer is stale


@dataclass(frozen=True)
class Upkeep:
    """What happens beside the update, every `every_s` seconds of sample time; 0: never.

    forget_s, shared_forget_s: time constants after which blocks and shared unknowns have given up
    what news replaced.  innovation_sd: rows further from the map held are refused, after
    `innovation_rows` in a row the gate opens; 0: no gate.  folds: interleaved parts of the record,
    changed at every upkeep, whose sums are kept apart for cross-validation.  history_s: raw samples
    of so many seconds are kept, at `history_rows_per_s`, for refits and the diagnosis; 0: none.
    gain_walk: standard deviation of what the gain of all maps changes by in a second, a share of
    it; see `rtid.estimator.walking`.
    """

    every_s: float = 0.0
    forget_s: float = np.inf
    shared_forget_s: float = np.inf
    innovation_sd: float = 0.0
    innovation_rows: int = 100
    folds: int = 1
    history_s: float = 0.0
    history_rows_per_s: float = 1000.0
    gain_walk: float = 0.0

    @property
    def fades(self) -> bool:
        """Whether anything of what was learned is given up again."""
        forgets = np.isfinite(self.forget_s) or np.isfinite(self.shared_forget_s)
        gives_up = forgets or self.innovation_sd > 0 or self.gain_walk > 0
        return bool(self.every_s > 0 and gives_up)


@dataclass(frozen=True)
class Machine:
    """The whole declared machine.  `signals` fixes the column order of the samples' values."""

    signals: tuple[Signal, ...]
    chambers: tuple[Chamber, ...]
    edges: tuple[Edge, ...]
    position: str
    beta_nominal_pa: float
    beta_bounds_pa: tuple[float, float]
    lag: Lag = field(default_factory=Lag)
    filter: Filter = field(default_factory=Filter)
    gates: Gates = field(default_factory=Gates)
    upkeep: Upkeep = field(default_factory=Upkeep)
    form: str = "integral"  # or "carry", "restart"
    terms: tuple[Term, ...] = ()
    pressure_period_s: float = 0.0  # sampling period of the pressures; 0: every sample
    # Variance of a pressure at the rows as a share of its sensor's: 1 where it is measured there,
    # f^2 + (1 - f)^2 where it is interpolated at the fraction f between two samples.
    pressure_share: float = 1.0
    # Blocks that may ring at once before memory begins anew: fewer need less memory on fine grids,
    # where a block is coupled to all that were visited within its memory, and cost information.
    recent_blocks: int = 64
    mode: str = NONE  # the signal that carries the number of the working mode
    # Of a plant whose rate is measured itself, y = f(u): that signal; `position` is its integral.
    measured: str = NONE
    # The samples are of several records one after the other: no clock tells of the time in between.
    joined: bool = False

    @property
    def has_pressures(self) -> bool:
        """False for a plant that is xdot = phi(x)' theta + f(u, x) of something else."""
        return any(chamber.pressure for chamber in self.chambers)

    @property
    def maps(self) -> tuple[Edge, ...]:
        """The edges with a map of their own, in the order of their blocks."""
        return tuple(edge for edge in self.edges if not edge.shares)

    @property
    def owners(self) -> tuple[int, ...]:
        """Place among the edges of the one whose map each has: its own, unless it shares one."""
        places = {edge.name: i for i, edge in enumerate(self.edges)}
        return tuple(places[edge.shares or edge.name] for edge in self.edges)

    @property
    def n_cells(self) -> int:
        """Number of blocks of all grids."""
        return sum(edge.grid.shape[0] * edge.grid.shape[1] for edge in self.maps)

    @property
    def first_cells(self) -> tuple[int, ...]:
        """Number of the first block of each edge's map among the blocks of all grids."""
        first, at = dict[str, int](), 0
        for edge in self.maps:
            first[edge.name] = at
            at += edge.grid.shape[0] * edge.grid.shape[1]
        return tuple(first[edge.shares or edge.name] for edge in self.edges)

    def unit_here(self, unit: str) -> str:
        """An SI unit as effects have it, as it is on this machine.

        V is that of its command, m3/s that of its equations: of a force that is measured, N.
        """
        rate = self.chambers[0].unit
        if unit in ("V", "V/s"):
            return self.signals[self.column(self.edges[0].command)].unit + unit.removeprefix("V")
        if unit == FLOW or unit.startswith(f"{FLOW}/"):
            return rate + unit.removeprefix(FLOW)
        if self.has_pressures or not (unit == VOLUME or unit.startswith(f"{VOLUME}/")):
            return unit
        whole = rate.removesuffix("/s") if rate.endswith("/s") else f"{rate} s"
        return whole + unit.removeprefix(VOLUME)

    def axes(self, edge: Edge) -> Axes:
        """What an edge's map is over: the only place that says in which units."""
        command = self.signals[self.column(edge.command)].unit or "V"
        if self.has_pressures:
            return Axes(command)
        over = edge.source or edge.sink
        return Axes(command, self.signals[self.column(over)].unit if over else "1", over)

    @property
    def with_taylor_maps(self) -> Machine:
        """The same machine with every map in Taylor terms, as maps are published."""
        return replace(self, edges=tuple(replace(e, basis=TAYLOR) for e in self.edges))

    def with_noise(self, noise: Mapping[str, float]) -> Machine:
        """The same machine with the noise of some signals (1 sigma, SI), by name, replaced."""
        signals = tuple(replace(s, noise=noise.get(s.name, s.noise)) for s in self.signals)
        return replace(self, signals=signals)

    def ahead(self, name: str) -> str:
        """The signal that carries the mean of `name` up to the next sample: itself without one."""
        is_there = any(signal.name == AHEAD + name for signal in self.signals)
        return AHEAD + name if is_there else name

    def column(self, name: str) -> int:
        """Column of the signal `name` in `Samples.values`; KeyError if the model has none."""
        for j, signal in enumerate(self.signals):
            if signal.name == name:
                return j
        raise KeyError(f"the model has no signal {name!r}")
