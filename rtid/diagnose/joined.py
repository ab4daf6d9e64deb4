"""Where an open valve joins two pressures at rest: there their sensors must show the same.

A valve that is open, and whose chamber neither moves nor stores, passes what leaks there and no
more, so that what its two sensors show differs by their zeros and by what drives that leak:

    p_source - p_sink = (b_source - b_sink) + R q,     q <= A |dx/dt| + V |dp/dt| / beta + q_leak.

R: of the valve as the fitted map has it, at this command and at the smallest drop that it knows;
laws whose flow bends down with the drop, the root above all, need less for a small flow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rtid.diagnose.fit import Fit
from rtid.diagnose.regression import Score
from rtid.diagnose.residual import transformed_like
from rtid.diagnose.trials import detection_limit
from rtid.effects.column import Candidate
from rtid.effects.laws import cause_of
from rtid.effects.record_view import RecordView
from rtid.kernels.engine import GAP_FLAG
from rtid.model import Chamber, Edge, Machine, Signal
from rtid.plain import BoolArray, FloatArray, IntArray
from rtid.units import UNIFORM

HALF_S = 0.25  # of a window: two halves tell whether anything moves
LEAST_SAMPLES = 4  # of a half
STILL = 2e-3  # of the rated flow: a chamber whose oil moves by more does not rest
OPEN = 0.2  # of its largest gain, from which a valve counts as open
SURE = 0.05  # of a block's mean flow, that its standard deviation may be
MOST_PA = 1e6  # two sensors that show more apart are not joined, whatever the command says
SEEN = 0.1  # of a leak's column that must be left beside the maps for its limit to count
FLOW = "flow"  # the kind of an effect that takes or gives oil


@dataclass(frozen=True)
class Joint:
    """One span in which an edge joins its ends at rest: what they show apart, Pa.

    apart_pa: source minus sink, less `drop_pa`; sd_pa: of the sensors' noise and of what may flow
    all the same; drop_pa: half of the most that drives the known leaks, more or less itself, for
    the law near zero is not known; begin_s, end_s: of the record.
    """

    edge: str
    source: str
    sink: str
    apart_pa: float
    sd_pa: float
    drop_pa: float
    begin_s: float
    end_s: float


@dataclass(frozen=True)
class _Windows:
    """Windows of a record: first sample and length of each half (w, 2); time of each (w,), s."""

    first: IntArray
    count: IntArray
    t_s: FloatArray

    def halves(self, values: FloatArray) -> FloatArray:
        """Means of values (n,) over the halves (w, 2)."""
        sums = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray((sums[self.first + self.count] - sums[self.first]) / self.count)

    def everywhere(self, is_so: BoolArray) -> BoolArray:
        """True (w,) where it is so at every sample (n,) of a window."""
        return np.asarray((self.halves(is_so.astype(float)) == 1.0).all(axis=1))


def joints(fit: Fit, chunk: FloatArray, scores: list[tuple[Candidate, Score]]) -> tuple[Joint, ...]:
    """Every span of chunk (n, 2 + signals), SI, in which an edge joins two pressures at rest.

    fit: whose maps say how far a valve is open; scores: of the effects that are not part of it,
    whose limits bound what may leak unseen.
    """
    windows = _windows(chunk)
    if not len(windows.t_s):
        return ()
    resting = [
        (i, c, at)
        for i, edge in enumerate(fit.declared.edges)
        for c, chamber in enumerate(fit.declared.chambers)
        if edge.sign(chamber) and (at := _resting(fit, chunk, windows, edge, chamber)).any()
    ]
    if not resting:
        return ()
    leaks = _leaks(fit, chunk, windows, scores)
    return tuple(
        joint
        for i, c, at in resting
        for joint in _spans(fit, chunk, windows, i, c, at, *(leak[c] for leak in leaks))
    )


def _windows(chunk: FloatArray) -> _Windows:
    """Windows without a gap, one behind the other."""
    t_s = chunk[:, 0]
    n = int((t_s[-1] - t_s[0]) / (2 * HALF_S)) if len(t_s) else 0
    edges = np.searchsorted(t_s, (t_s[0] if n else 0.0) + HALF_S * np.arange(2 * n + 1))
    first, count = edges[:-1].reshape(-1, 2), np.diff(edges).reshape(-1, 2)
    usual = HALF_S / float(np.median(np.diff(t_s))) if len(t_s) > 1 else np.inf
    whole = (count >= max(LEAST_SAMPLES, 0.9 * usual)).all(axis=1)
    windows = _Windows(first[whole], count[whole], t_s[first[whole, 0]] if n else t_s[:0])
    gap = (chunk[:, 1].astype(int) & GAP_FLAG) != 0
    at = windows.everywhere(~gap)
    return _Windows(windows.first[at], windows.count[at], windows.t_s[at])


def _resting(
    fit: Fit, chunk: FloatArray, windows: _Windows, edge: Edge, chamber: Chamber
) -> BoolArray:
    """True (w,) where this edge alone is open to a chamber that neither moves nor stores."""
    machine = fit.declared
    opens_v = opening(_gains(fit, edge), edge.grid.u_v) if chamber.pressure else np.inf
    if not np.isfinite(opens_v):
        return np.zeros(len(windows.t_s), bool)
    is_open = _opening(machine, chunk, edge) >= opens_v
    for other in machine.edges:
        if other is not edge and other.sign(chamber):
            is_open &= _opening(machine, chunk, other) <= other.shut_up_to_v
    flow = _net_flow(fit, chunk, windows, chamber)
    return windows.everywhere(is_open) & (flow < STILL * edge.rated_q_m3s)


def _opening(machine: Machine, chunk: FloatArray, edge: Edge) -> FloatArray:
    """The command of an edge (n,), in its direction; 0 in modes in which it is shut."""
    w = edge.direction * chunk[:, 2 + machine.column(edge.command)]
    return np.where(RecordView.without_map(machine, chunk).may_open(edge), w, 0.0)


def _net_flow(fit: Fit, chunk: FloatArray, windows: _Windows, chamber: Chamber) -> FloatArray:
    """What the chamber takes (w,), m3/s: by its motion and by what it stores."""
    machine = fit.declared
    c = machine.chambers.index(chamber)
    x, p = (windows.halves(chunk[:, 2 + machine.column(name)])
            for name in (machine.position, chamber.pressure))  # fmt: skip
    v, rate = ((half[:, 1] - half[:, 0]) / HALF_S for half in (x, p))
    volume = chamber.v0_m3 + chamber.sign * chamber.area_m2 * x.mean(axis=1)
    stored = volume * abs(float(fit.compliance[c])) * np.abs(rate)
    return np.asarray(chamber.area_m2 * np.abs(v) + stored)


def _known(fit: Fit, edge: Edge) -> tuple[FloatArray, FloatArray]:
    """Mean flow, m3/s, of the blocks of an edge that are known well, and drop, Pa: (nu, nd).

    NaN elsewhere.
    """
    machine = fit.model
    shape, size = edge.grid.shape, edge.grid.shape[0] * edge.grid.shape[1]
    first = machine.first_cells[[e.name for e in machine.edges].index(edge.name)]
    mine = (fit.map.cells >= first) & (fit.map.cells < first + size)
    flow = np.full(size, np.nan)
    mean = fit.map.terms[mine, 0]
    if len(fit.map.cov):
        mean = np.where(fit.map.cov[mine, 0, 0] < (SURE * mean) ** 2, mean, np.nan)
    flow[fit.map.cells[mine] - first] = mean * edge.rated_q_m3s
    middle = 0.5 * (edge.grid.dp_pa[1:] + edge.grid.dp_pa[:-1])
    return flow.reshape(shape), np.broadcast_to(middle, shape)


def _gains(fit: Fit, edge: Edge) -> FloatArray:
    """Q / sqrt(dp) of an edge at each command of its grid (nu,), NaN where nothing is known."""
    flow, dp = _known(fit, edge)
    forward = flow * dp > 0.0
    gains = np.where(forward, np.abs(flow) / np.sqrt(np.maximum(np.abs(dp), 1.0)), np.nan)
    return np.array([np.nanmedian(row) if np.isfinite(row).any() else np.nan for row in gains])


def opening(gains: FloatArray, u_v: FloatArray) -> float:
    """The command, V, from which on a map passes a fair part of its most; inf where it never does.

    gains (nu,): Q / sqrt(dp), NaN where nothing is known, at the commands u_v (nu + 1,).  Whose
    furthest known command passes little is not known to be open anywhere.
    """
    known = np.flatnonzero(np.isfinite(gains))
    shut = known[gains[known] <= OPEN * gains[known].max(initial=0.0)]
    wide = known[known > shut.max(initial=-1)]
    return float(u_v[wide[0]]) if len(wide) else np.inf


def _resistance(fit: Fit, edge: Edge, w: FloatArray) -> FloatArray:
    """R (w,), Pa s/m3, at the commands w (w,): the smallest drop that is known over its flow.

    A command beyond all that is known opens further: no more than there.
    """
    flow, dp = _known(fit, edge)
    drops = np.where(flow * dp > 0.0, np.abs(dp), np.inf)
    gains = np.nan_to_num(_gains(fit, edge))
    with np.errstate(divide="ignore", invalid="ignore"):
        rows = np.where(gains > 0.0, np.sqrt(drops.min(axis=1)) / gains, np.inf)
    least = np.minimum.accumulate(rows)
    at = np.clip(np.searchsorted(edge.grid.u_v, w, side="right") - 1, 0, len(least) - 1)
    return np.asarray(least[at])


def _leaks(
    fit: Fit, chunk: FloatArray, windows: _Windows, scores: list[tuple[Candidate, Score]]
) -> tuple[FloatArray, FloatArray]:
    """Into each chamber (chambers, w), m3/s: what is known to leak, and what may leak unseen."""
    machine = fit.model
    known, unseen = (np.zeros((len(machine.chambers), len(windows.t_s))) for _ in range(2))
    view = RecordView.of(machine, transformed_like(fit, chunk), fit.weights, fit.map)
    for effect in fit.revision.effects:
        if effect.law.kind == FLOW:
            value = fit.held.value(fit.column(effect))
            for c, flow in _flows(view, windows, effect):
                known[c] += value * flow
    for candidate, score in scores:
        if candidate.law.kind == FLOW and score.visible > SEEN:
            limit = min(detection_limit(score, fit.rho), candidate.largest)
            for c, flow in _flows(view, windows, candidate):
                unseen[c] = np.maximum(unseen[c], limit * np.abs(flow))
    return known, unseen


def _flows(
    view: RecordView, windows: _Windows, effect: Candidate
) -> Iterator[tuple[int, FloatArray]]:
    """Chamber and flow (w,) into it, m3/s, of an effect with a coefficient of 1."""
    for c, volumes in cause_of(view, effect).column(effect.shape).items():
        flow = np.append(volumes / view.dt_s, 0.0)
        yield c, windows.halves(flow).mean(axis=1)


def _spans(
    fit: Fit,
    chunk: FloatArray,
    windows: _Windows,
    i: int,
    c: int,
    at: BoolArray,
    known: FloatArray,
    unseen: FloatArray,
) -> Iterator[Joint]:
    """The joints of edge i by chamber c, whose windows `at` (w,) rest; leaks into it (w,), m3/s."""
    machine = fit.declared
    edge, chamber = machine.edges[i], machine.chambers[c]
    source, sink = (machine.signals[machine.column(name)] for name in (edge.source, edge.sink))
    shown = chunk[:, 2 + machine.column(edge.source)] - chunk[:, 2 + machine.column(edge.sink)]
    apart = windows.halves(shown).mean(axis=1)
    opening = windows.halves(_opening(machine, chunk, edge)).mean(axis=1)
    resistance = np.where(at, _resistance(fit, edge, opening), 0.0)
    drop = -0.5 * edge.sign(chamber) * resistance * known
    doubt = resistance * (_net_flow(fit, chunk, windows, chamber) + unseen) / UNIFORM
    noise, stuck = np.hypot(source.noise, sink.noise), _stuck(source) + _stuck(sink)
    for span in np.split(np.arange(len(at)), 1 + np.flatnonzero(np.diff(at.astype(int)))):
        if at[span[0]] and np.abs(apart[span]).max() < MOST_PA:
            samples = float(windows.count[span].sum())
            random = np.sqrt(noise**2 / samples + np.var(apart[span]) / len(span) + stuck)
            yield Joint(
                edge.name, edge.source, edge.sink,
                float(np.mean((apart - drop)[span])), float(np.hypot(random, doubt[span].max())),
                float(np.mean(drop[span])),
                float(windows.t_s[span[0]]), float(windows.t_s[span[-1]] + 2 * HALF_S),
            )  # fmt: skip


def _stuck(signal: Signal) -> float:
    """Variance, SI squared, of what rounding adds to the mean of any number of samples at rest.

    A level between two steps q is off by the same at each sample, q^2/12, unless noise s dithers
    it: then its k-th harmonic is left by exp(-(2 pi k s/q)^2), and no more than the first of all.
    Without it a zero of 2.5 kPa in steps of 6.1 kPa was told as 6104 +- 19 Pa.
    """
    if not signal.resolution:
        return 0.0
    dithered = np.exp(-((2.0 * np.pi * signal.noise / signal.resolution) ** 2))
    return float(dithered * signal.resolution**2 / 12.0)
