"""Which block each interval of a record belongs to: the oracle's own reading of the declared rules.

Written as plain Python, independently of the kernels.  Only one thing is asked of the engine: where
it began a new memory because too many blocks rang at once, which depends on its table size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rtid.estimator.state import Weights, build
from rtid.kernels.layout import RESTART_MEMORY
from rtid.model import TAYLOR, Chamber, Edge, Machine
from rtid.plain import BoolArray, FloatArray, IntArray

ROW, GAP = 1, 2  # flags of a sample, as in firmware_bridge.samples


@dataclass(frozen=True)
class Track:
    """The m intervals that are used, in order of time, each between the samples end - 1 and end.

    end (m,); fresh (m,): memory begins at the interval's start; started_s (m,): since when the
    record has run without a break; row (m,): the position was measured at its end;
    cells (m, edges, 2): block (i, j), -1 when shut; where windows overlap, the first of the blocks
    that share the point; home (m, edges, 2): the block that holds it;
    opening (m, edges, 2): command held over the interval, lagged command at its start, volts.
    """

    end: IntArray
    fresh: BoolArray
    started_s: FloatArray
    row: BoolArray
    cells: IntArray
    home: IntArray
    opening: FloatArray


def follow(
    model: Machine, t_s: FloatArray, values: FloatArray, flags: IntArray, weights: Weights
) -> Track:
    """Gates, restarts and block assignment with hysteresis, sample by sample.

    t_s (n,), values (n, signals) in the model's column order, flags (n,).
    """
    new_memory = _memory_restarts(model, t_s, values, flags, weights)
    usable = _usable(model, t_s, values)
    intervals: list[tuple[int, bool, float, bool]] = []
    cells, homes, openings = [], [], []
    running, fresh, started, ready = False, False, 0.0, -np.inf
    cell, w = _all_shut(model), np.zeros(len(model.edges))
    for k in range(len(t_s)):
        broken = k == 0 or not usable[k] or bool(flags[k] & GAP)
        broken = broken or not 0.0 < t_s[k] - t_s[k - 1] <= model.gates.max_gap_s
        inside = True
        if not usable[k] or (running and broken):
            stamped = t_s[k] if np.isfinite(t_s[k]) else _last_usable(t_s, usable, k)
            ready = stamped + model.gates.recovery_s
        if running and not broken:
            command = _held(model, values[k - 1], values[k])
            mean, last = _lagged(command, w, weights.lag_s, t_s[k] - t_s[k - 1])
            before = cell
            cell, home, inside = _cells(model, values[k - 1 : k + 1], mean, cell)
            if inside:
                fresh = fresh or (model.form == "restart" and bool((cell != before).any()))
                intervals.append((k, fresh or bool(new_memory[k]), started, bool(flags[k] & ROW)))
                cells.append(cell)
                homes.append(home)
                openings.append(np.stack([command, w], axis=1))
                w, fresh = last, False
        was_running = running
        running = running and not broken and inside
        if not running:
            cell = _all_shut(model)
            may_start = usable[k] and flags[k] & ROW and t_s[k] >= ready
            if may_start and not (was_running and not broken):
                running, fresh, started, w = True, True, t_s[k], _held(model, values[k])
    ends, begins, since, rows = zip(*intervals, strict=True) if intervals else ((), (), (), ())
    return Track(
        np.array(ends, np.int64),
        np.array(begins, bool),
        np.array(since, float),
        np.array(rows, bool),
        np.array(cells, np.int64).reshape(-1, len(model.edges), 2),
        np.array(homes, np.int64).reshape(-1, len(model.edges), 2),
        np.array(openings, float).reshape(-1, len(model.edges), 2),
    )


def _usable(model: Machine, t_s: FloatArray, values: FloatArray) -> BoolArray:
    low = np.array([s.minimum for s in model.signals])
    high = np.array([s.maximum for s in model.signals])
    whole = np.isfinite(t_s) & (np.abs(values) < 1e30).all(axis=1)
    return whole & (values >= low).all(axis=1) & (values <= high).all(axis=1)


def _last_usable(t_s: FloatArray, usable: BoolArray, k: int) -> float:
    before = np.flatnonzero(usable[:k])
    return float(t_s[before[-1]]) if len(before) else 0.0


def _held(model: Machine, sample: FloatArray, after: FloatArray | None = None) -> FloatArray:
    """Command of each edge (edges,); zero in a mode that keeps it shut.

    after (signals,): the next sample, to which a command that is a measurement goes straight.
    """
    mode = int(sample[model.column(model.mode)]) if model.mode else 0
    if after is not None:
        is_held = np.array([signal.is_held for signal in model.signals])
        sample = np.where(is_held, sample, 0.5 * (sample + after))
    return np.array(
        [
            0.0
            if edge.modes and mode not in edge.modes
            else edge.direction * sample[model.column(edge.command)]
            for edge in model.edges
        ]
    )


_SLOPES: dict[str, Callable[[FloatArray], FloatArray]] = {
    "linear": np.ones_like,
    "root": lambda z: 0.5 / np.sqrt(np.maximum(np.abs(z), 1e-12)),
    "hinge": lambda z: (z > 0.0).astype(float),
    "inverse": lambda z: 1.0 / z**2,
}


def stored_per_pressure(model: Machine, values: FloatArray, compliance: FloatArray) -> FloatArray:
    """V / beta and what terms of a rate store at theta = 1 (..., chambers), m3/Pa.

    values (..., signals), SI; compliance (chambers,), 1/Pa.
    """
    x = values[..., model.column(model.position)]
    volume = {c.name: c.volume(x) for c in model.chambers}
    soft = {c.name: volume[c.name] * compliance[i] for i, c in enumerate(model.chambers)}
    for term in (term for term in model.terms if term.rate):
        z = term.constant + sum(w * values[..., model.column(name)] for name, w in term.weights)
        slope = term.scale * _SLOPES[term.shape](np.asarray(z)) * volume.get(term.volume, 1.0)
        for name, sign in term.signs:
            weight = dict(term.weights).get(_chamber(model, name).pressure, 0.0)
            soft[name] = soft[name] + sign * weight * slope
    return np.stack([np.asarray(soft[c.name]) for c in model.chambers], axis=-1)


def _chamber(model: Machine, name: str) -> Chamber:
    return next(c for c in model.chambers if c.name == name)


def pressure_drop(model: Machine, edge: Edge, values: FloatArray) -> FloatArray:
    """dp over the edge (...,), Pa, from values (..., signals); an end that is NONE is at zero."""
    ends = [values[..., model.column(name)] if name else 0.0 for name in (edge.source, edge.sink)]
    return np.zeros(values.shape[:-1]) + ends[0] - ends[1]


def _lagged(
    command: FloatArray, start: FloatArray, lag_s: float, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Mean and last value over dt of a command that approaches `command` from `start`."""
    if lag_s <= 0.0:
        return command, command
    decay = np.exp(-dt / lag_s)
    mean = command + (start - command) * (lag_s / dt * (1.0 - decay))
    return mean, command + (start - command) * decay


def _all_shut(model: Machine) -> IntArray:
    return np.full((len(model.edges), 2), -1, np.int64)


def _cells(
    model: Machine, samples: FloatArray, mean_w: FloatArray, before: IntArray
) -> tuple[IntArray, IntArray, bool]:
    """Blocks and homes per edge of the interval between two samples; False: one is off its grid."""
    cell, home, inside = _all_shut(model), _all_shut(model), True
    for i, edge in enumerate(model.edges):
        if mean_w[i] <= edge.safe_band_v:
            continue
        point = (mean_w[i], float(pressure_drop(model, edge, samples).mean()))
        if edge.basis != TAYLOR:
            home[i] = _cell(edge, point, _all_shut(model)[i], 0.0)
            cell[i] = _first_window(edge, point, home[i])
        else:
            cell[i] = home[i] = _cell(edge, point, before[i], model.gates.hysteresis)
        inside = inside and bool(home[i].min() >= 0)
    return cell, home, inside


def _first_window(edge: Edge, point: tuple[float, float], home: IntArray) -> IntArray:
    """Along each axis: the first of the two windows that overlap at the point."""
    out = home.copy()
    for axis, border in enumerate((edge.grid.u_v, edge.grid.dp_pa)):
        i, n = home[axis], len(border) - 1
        if i >= 0:
            first = i - 1 if point[axis] < 0.5 * (border[i] + border[i + 1]) else i
            out[axis] = max(0, min(first, n - 2))
    return out


def _cell(edge: Edge, point: tuple[float, float], before: IntArray, hysteresis: float) -> IntArray:
    """Along each axis: the block before, widened by the hysteresis, else where the point lies."""
    out = np.full(2, -1, np.int64)
    for axis, (border, value) in enumerate(
        zip((edge.grid.u_v, edge.grid.dp_pa), point, strict=True)
    ):
        if before[axis] >= 0:
            low, high = border[before[axis]], border[before[axis] + 1]
            margin = hysteresis * (high - low)
            if low - margin <= value <= high + margin:
                out[axis] = before[axis]
                continue
        if border[0] <= value <= border[-1]:
            at = int(np.searchsorted(border, value, side="right")) - 1
            out[axis] = min(at, len(border) - 2)
    return out


def _memory_restarts(
    model: Machine, t_s: FloatArray, values: FloatArray, flags: IntArray, weights: Weights
) -> BoolArray:
    """(n,): the engine began a new memory with the interval that ends at this sample."""
    state = build(model, weights)
    chunk = np.column_stack([t_s, flags, values])
    count = np.zeros(len(t_s), np.int64)
    for k in range(len(t_s)):
        state.advance(chunk[k : k + 1])
        count[k] = state.engine[0]["counters"][RESTART_MEMORY]
    return np.diff(count, prepend=0) > 0
