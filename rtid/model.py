"""What the user declares about the machine: chambers, metering edges, grids, noise and priors.

Per chamber c the pressure equation (14) of IMECE2005-79420, all terms in m3/s, is

    s_c A_c v = - V_c(x) dP_c/dt * theta_beta_c + sum over open edges of sigma * Q_edge(u, dp)

with V_c(x) = V0_c + s_c A_c x, theta_beta_c = 1 / beta_c, and sigma = +1 for an edge that feeds
the chamber, -1 for one that drains it.  Everything here is SI and immutable; the project file
(`rtid.project`) is turned into one `Model`, and nothing below this module knows a file.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

COMMAND, PRESSURE, POSITION, VELOCITY = "command", "pressure", "position", "velocity"


@dataclass(frozen=True)
class Signal:
    """One column of the samples: its role, sensor noise (1 sigma, SI unit) and resolution (SI)."""

    name: str
    kind: str  # COMMAND, PRESSURE, POSITION or VELOCITY
    unit: str = ""  # SI unit (or V, A, PWM for a command)
    noise: float = 0.0
    resolution: float = 0.0
    minimum: float = -np.inf  # a value outside [minimum, maximum] is refused: gate "range"
    maximum: float = np.inf


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
    """One pressure equation: `pressure` names its signal, V(x) = v0_m3 + sign * area_m2 * x."""

    name: str
    pressure: str
    area_m2: float
    sign: int  # +1: the volume grows with x, -1: it shrinks
    v0_m3: float


@dataclass(frozen=True)
class Edge:
    """A metering edge with its own map Q(u, dp), dp = p_source - p_sink, Q > 0 from source to sink.

    `source` and `sink` name pressure signals.  The edge opens with w = direction * u of the signal
    `command`; for w <= safe_band_v it passes nothing (prior knowledge, can be -inf to switch off).
    The grid is in terms of w.  rated_* give the size of the flow for scaling and first weights.
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


@dataclass(frozen=True)
class Term:
    """A shared flow, linear in signals: theta * scale * (sum of weights * signal + constant).

    weights: (signal, weight) pairs of quantities that run linearly between samples; signs:
    (chamber, +1 or -1) pairs.  A laminar internal leakage has weights p_a: 1, p_b: -1, signs a: -1,
    b: +1, and a scale in m3/s/Pa near the coefficient that is expected.
    """

    name: str
    weights: tuple[tuple[str, float], ...]
    signs: tuple[tuple[str, int], ...]
    scale: float
    constant: float = 0.0


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
    hysteresis: float = 0.05  # share of a block's width that the working point must leave it by
    min_rows: int = 20  # rows that a block needs before it can become valid
    max_sd_share: float = 0.001  # of the edge's largest flow: known worse than this is not valid


@dataclass(frozen=True)
class Model:
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
    form: str = "integral"  # or "carry"
    terms: tuple[Term, ...] = ()
    pressure_period_s: float = 0.0  # sampling period of the pressures; 0: every sample
    # Variance of a pressure at the rows as a share of its sensor's: 1 where it is measured there,
    # f^2 + (1 - f)^2 where it is interpolated at the fraction f between two samples.
    pressure_share: float = 1.0

    def column(self, name: str) -> int:
        """Column of the signal `name` in `Samples.values`; KeyError if the model has none."""
        for j, signal in enumerate(self.signals):
            if signal.name == name:
                return j
        raise KeyError(f"the model has no signal {name!r}")
