"""Does the machine move as declared?  Signs, swapped chambers, stiffness, velocity.

Two tests need no fit of the maps.  Open edges move the piston the way they say: over windows,
corr(push, dx) > 0 with push = sum(direction sigma s_c w).  And each chamber is a spring:

    s_c A_c dx = - V_c dP_c theta_c + sum(k_e(u) root(dp_e)),   theta_c = 1 / beta_c > 0,

root(dp) = sgn(dp) sqrt(|dp|), over what the chamber's valves lead to; k_e is straight in each bin
of the command.  The level of P_c in their place made a drained chamber softer than nothing, where a
pump follows its load.  Signals of a window are means by the trapezoid rule: by the samples before
its end alone the flow is half a sample late, which looks as if pressure fell in compression.

A reversed command turns the first sign alone, a reversed position both, swapped chamber pressures
the second alone; a wrong unit makes 1 / theta_c no bulk modulus.

Compression is seen while it lasts.  A chamber settles by its valve's flow within

    V_c / (beta dQ/dP) = 2 V_c dP / (beta Q),   Q = A_c |v|,

and over longer windows its pressure follows the load and the flow, either way round.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.samples import GAP, ROW, Samples
from rtid.model import Chamber, Machine
from rtid.plain import BoolArray, FloatArray
from rtid.units import Unit, units_of

WINDOW_S = 0.02
MIN_WINDOWS = 100
COMMAND_BINS = 40  # at most
WINDOWS_PER_BIN = 20  # at least: each bin knows its flow by six unknowns
SAME = 1e-6  # share of the largest singular value, below which two drops are one
TINY = 1e-300
JUMP = 0.05  # of a command's range, within a window
LONGEST = 1.25  # of WINDOW_S: a window of whole samples that is still as short as meant


@dataclass(frozen=True)
class Spring:
    """Rough bulk modulus of one chamber, Pa, and its t value; NaN where too little moved.

    settles_s: time in which its pressure settles at the speeds of the record.
    """

    beta_pa: float
    t: float
    settles_s: float = math.inf


@dataclass(frozen=True)
class Motion:
    """How the machine moves, each NaN where nothing can be told.

    u_to_v: correlation of push and motion, positive as declared; v_slope: measured velocity over
    the derivative of the position, 1 where both agree; window_s: over which changes are taken, as
    long as the rate demands.
    """

    u_to_v: float
    springs: dict[str, Spring]
    v_slope: float
    window_s: float = 0.0

    def is_too_slow(self, spring: Spring) -> bool:
        """Whether a chamber settles between samples, so that its compression is not seen."""
        return self.window_s > max(spring.settles_s, LONGEST * WINDOW_S)


@dataclass(frozen=True)
class Windows:
    """Of windows without a gap: means of all signals, first values and changes (n, m); length.

    calm (n,): no command has jumped in it, or in the one before.
    """

    mean: FloatArray
    start: FloatArray
    change: FloatArray
    length_s: float
    calm: BoolArray

    def calmed(self) -> Windows:
        """Those in which no spool is behind a jump: the mean command says what it lets through.

        A joystick's steps, each with its spool's lag, at 100 rows a second were a spring of -168
        MPa, 60 standard deviations clear: the pressures of a healthy machine were swapped.
        """
        here = self.calm
        mean, start, change, calm = (
            self.mean[here], self.start[here], self.change[here], self.calm[here],
        )  # fmt: skip
        return Windows(mean, start, change, self.length_s, calm)


def motion(model: Machine, samples: Samples) -> Motion:
    """Judge signs and stiffness from the samples of a trace."""
    windows = _windows(model, samples)
    if len(windows.mean) < MIN_WINDOWS:
        nothing = Spring(float("nan"), float("nan"))
        return Motion(float("nan"), {c.name: nothing for c in model.chambers}, float("nan"))
    springs = {c.name: _clear_spring(model, c, windows) for c in model.chambers if c.pressure}
    v_slope = _v_slope(model, samples)
    return Motion(_u_to_v(model, windows), springs, v_slope, windows.length_s)


def _windows(model: Machine, samples: Samples) -> Windows:
    """Windows of 20 ms, but of two rows at least; each border lies on a row."""
    rows = np.flatnonzero(samples.flags & ROW)
    if len(rows) < 3:
        nothing = np.empty((0, len(samples.names)))
        return Windows(nothing, nothing, nothing, 0.0, np.zeros(0, bool))
    period_s = float(np.median(np.diff(samples.t_us[rows]))) * 1e-6
    steps = max(2, round(WINDOW_S / period_s))
    border = rows[::steps]
    total = np.concatenate([np.zeros((1, len(samples.names))), np.cumsum(samples.values, axis=0)])
    whole, values = _unbroken(model, samples, border), samples.values[border]
    change = np.diff(values, axis=0)
    calm = _calm(model, change, np.ptp(samples.values, axis=0))
    mean = (np.diff(total[border], axis=0) + 0.5 * change) / np.diff(border)[:, None]
    return Windows(mean[whole], values[:-1][whole], change[whole], steps * period_s, calm[whole])


def _calm(model: Machine, change: FloatArray, sizes: FloatArray) -> BoolArray:
    """Whether no command jumps in a window, or in the one before, bool (n,).

    change (n, m): of all signals over each window; sizes (m,): their ranges in the record.
    """
    at = sorted({model.column(edge.command) for edge in model.edges})
    moved = np.any(np.abs(change[:, at]) > JUMP * sizes[at], axis=1)
    return ~(moved | np.append(False, moved[:-1]))


def _unbroken(model: Machine, samples: Samples, border: NDArray[np.intp]) -> BoolArray:
    """Whether the samples between two borders follow one another without a gap, bool (n - 1,)."""
    step_s = np.diff(samples.t_us) * 1e-6
    joined = (step_s > 0) & (step_s <= model.gates.max_gap_s) & ((samples.flags[1:] & GAP) == 0)
    gaps = np.concatenate([[0], np.cumsum(~joined)])
    return np.asarray(np.diff(gaps[border]) == 0)


def _u_to_v(model: Machine, windows: Windows) -> float:
    signs = {c.pressure: c.sign for c in model.chambers}
    push = np.zeros(len(windows.mean))
    for edge in model.edges:
        extends = signs.get(edge.sink, 0) - signs.get(edge.source, 0)
        w = edge.direction * windows.mean[:, model.column(edge.command)]
        push += extends * np.maximum(w, 0.0)
    moved = windows.change[:, model.column(model.position)]
    size = float(np.sqrt(np.dot(push, push) * np.dot(moved, moved)))
    return float(np.dot(push, moved)) / size if size > 0 else float("nan")


def _clear_spring(model: Machine, chamber: Chamber, windows: Windows) -> Spring:
    """The spring of a chamber; of calm windows alone, where these say the opposite.

    They hold less of what is quick, and so of what is compressed.
    """
    every, calm = (_spring(model, chamber, w) for w in (windows, windows.calmed()))
    return calm if calm.t * every.t < 0.0 else every


def _spring(model: Machine, chamber: Chamber, windows: Windows) -> Spring:
    """Regress the swept volume on V dP, both beside what the valves let through."""
    x, p = model.column(model.position), model.column(chamber.pressure)
    stored = -chamber.volume(windows.start[:, x]) * windows.change[:, p]
    swept = chamber.sign * chamber.area_m2 * windows.change[:, x]
    beside, unknowns = _beside_valves(model, chamber, windows, np.stack([stored, swept], axis=1))
    stored, swept = beside.T
    dof, size = len(swept) - unknowns, float(np.dot(stored, stored))
    if not (size > 0 and dof > 0):
        return Spring(float("nan"), float("nan"))
    theta = float(np.dot(stored, swept)) / size
    residual = swept - theta * stored
    sd = float(np.sqrt(np.dot(residual, residual) / dof / size))
    if theta == 0 or not sd > 0:
        return Spring(float("nan"), float("nan"))
    return Spring(1.0 / theta, theta / sd, _settles_s(model, chamber, windows))


def _beside_valves(
    model: Machine, chamber: Chamber, windows: Windows, columns: FloatArray
) -> tuple[FloatArray, int]:
    """What a chamber's valves leave of columns (n, m) at each command, and by how many unknowns.

    A supply that stands still tells no drop of its own: the rank of each bin counts.
    """
    flows = _flows(model, chamber, windows)
    rest, unknowns, k = np.zeros(columns.shape), 0, _command_bin(model, windows)
    for number in np.unique(k):
        here = k == number
        phi = flows[here]
        phi /= np.maximum(np.linalg.norm(phi, axis=0), TINY)
        by, _, rank, _ = np.linalg.lstsq(phi, columns[here], rcond=SAME)
        rest[here] = columns[here] - phi @ by
        unknowns += int(rank)
    return rest, unknowns


def _flows(model: Machine, chamber: Chamber, windows: Windows) -> FloatArray:
    """Columns (n, m) whose sum a chamber's valves let through in a narrow range of the command."""
    edges = [e for e in model.edges if chamber.pressure in (e.source, e.sink)]
    drops = _drops_pa(model, chamber, windows)
    commands = {e.command: windows.mean[:, model.column(e.command)] for e in edges}
    roots = [np.sign(drop) * np.sqrt(np.abs(drop)) for drop in drops]
    opened = [u * root for u in commands.values() for root in roots]
    return np.stack([np.ones(len(windows.mean)), *commands.values(), *roots, *opened], axis=1)


def _drops_pa(model: Machine, chamber: Chamber, windows: Windows) -> list[FloatArray]:
    """Drops (n,), Pa, from a chamber to each pressure that its valves lead to."""
    pairs = [(e.source, e.sink) for e in model.edges if chamber.pressure in (e.source, e.sink)]
    ends = sorted({name for pair in pairs for name in pair} - {chamber.pressure})
    mine = windows.mean[:, model.column(chamber.pressure)]
    return [mine - windows.mean[:, model.column(name)] for name in ends]


def _settles_s(model: Machine, chamber: Chamber, windows: Windows) -> float:
    """Time in which a chamber settles, at the speed that weighs in its law, with oil of the middle.

    Of the two drops at its valves the smaller counts: by it the pressure settles sooner.
    """
    drop_pa = _smallest_drop_pa(model, chamber, windows)
    beta_pa = math.sqrt(model.beta_bounds_pa[0] * model.beta_bounds_pa[1])
    x = model.column(model.position)
    speed = float(np.sqrt(np.mean(windows.change[:, x] ** 2))) / windows.length_s
    volume = float(np.median(chamber.volume(windows.start[:, x])))
    flow = chamber.area_m2 * speed
    return 2.0 * volume * drop_pa / (beta_pa * flow) if flow > 0 else math.inf


def _smallest_drop_pa(model: Machine, chamber: Chamber, windows: Windows) -> float:
    """The smallest drop between a chamber and what its valves lead to, median of the windows."""
    drops = np.abs(_drops_pa(model, chamber, windows))
    return float(np.median(np.min(drops, axis=0))) if len(drops) else math.inf


def _command_bin(model: Machine, windows: Windows) -> NDArray[np.intp]:
    """Number of the bin of the command, bins of equal count."""
    command = next(s.name for s in model.signals if s.kind == "command")
    u = windows.mean[:, model.column(command)]
    bins = min(COMMAND_BINS, len(u) // WINDOWS_PER_BIN)
    return np.digitize(u, np.quantile(u, np.linspace(0, 1, bins + 1)[1:-1]))


def _v_slope(model: Machine, samples: Samples) -> float:
    """Least-squares slope of integrated velocity over position, NaN without a velocity signal."""
    names = [s.name for s in model.signals if s.kind == "velocity"]
    rows = np.flatnonzero(samples.flags & ROW)[::10]
    if not names:
        return float("nan")
    v, dt_s = samples.column(names[0]), np.diff(samples.t_us) * 1e-6
    travelled = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * dt_s)])
    whole = _unbroken(model, samples, rows)
    x = samples.column(model.position)[rows]
    dx, dv = np.diff(x)[whole], np.diff(travelled[rows])[whole]
    size = float(np.dot(dx, dx))
    return float(np.dot(dx, dv)) / size if size > 0 else float("nan")


def looks_like(value: float, low: float, high: float, declared: Unit) -> Unit | None:
    """The unit in which a value, read in `declared`, would lie between low and high (all SI).

    None if it lies there already or no unit does; of several the one that comes nearest to `high`
    on a logarithmic scale.
    """
    if not value > 0 or low <= value <= high:
        return None
    meant = {u: value * u.factor / declared.factor for u in units_of(declared.dimension)}
    fitting = [unit for unit, size in meant.items() if low <= size <= high]
    return max(fitting, key=lambda unit: meant[unit], default=None)
