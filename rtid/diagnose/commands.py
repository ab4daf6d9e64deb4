"""The commands of a record as they reach the spools, and the supply as the pump holds it.

Edges that open with u > 0 and with u < 0 may be parts of one spool or valves of their own (see
`timing`), so the machine is given a command for either direction, once anything has a timing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from firmware_bridge.samples import GAP, ROW
from rtid.effects.instants import Instants
from rtid.effects.laws.pump import demand
from rtid.effects.laws.response import behind_s
from rtid.effects.laws.sensors import sensors_of
from rtid.effects.laws.timing import COMMAND, SUPPLY, Psi, TimingLaw, lagged
from rtid.effects.record_view import NONE, RecordView
from rtid.model import Edge, Machine
from rtid.plain import FloatArray, IntArray

GAP_STEPS = 1.5  # usual steps: what is marked as a gap and takes no longer is all there
OFTEN = 0.9  # of the samples: a position that each of them holds is marked in all
FADED = 1e-4  # of the largest command of a map, to which a spool's has faded that is shut
Timings = tuple[tuple[TimingLaw, Psi], ...]


def split(model: Machine) -> Machine:
    """The same machine with a command of its own for either direction of every command.

    Spools of their own come to rest shut: one that lags only fades, and stood open for ever, where
    its map gives any flow of dp.  A relief valve was a lag of the spools, at 1.2 of the noise for
    282.  An edge that is never shut stays so.
    """
    signals, edges = list(model.signals), []
    for name in sorted({edge.command for edge in model.edges}):
        signal = model.signals[model.column(name)]
        signals += [replace(signal, name=_half(name, d)) for d in (1, -1)]
    for edge in model.edges:
        command, shut_v = _half(edge.command, edge.direction), edge.safe_band_v
        if shut_v >= 0.0:
            shut_v = max(shut_v, FADED * float(edge.grid.u_v[-1]))
        edges.append(replace(edge, command=command, safe_band_v=shut_v))
    return replace(model, signals=tuple(signals), edges=tuple(edges))


def _half(name: str, direction: int) -> str:
    return name + ("+" if direction > 0 else "-")


def half_of(edge: Edge) -> str:
    """The command of an edge and its direction, whether or not the machine is split."""
    return _half(edge.command.rstrip("+-"), edge.direction)


def behind(model: Machine, timings: Timings) -> Machine:
    """The machine of a record that is `transformed`."""
    return split(model) if timings else model


def commands(model: Machine, chunk: FloatArray) -> dict[str, tuple[int, FloatArray]]:
    """Direction and command (n,), V, as sent, by the names of the split machine.

    chunk (n, 2 + signals), SI.
    """
    by_edge: dict[str, tuple[int, FloatArray]] = {}
    for name in sorted({edge.command for edge in model.edges}):
        u = chunk[:, 2 + model.column(name)]
        by_edge |= {_half(name, d): (d, u) for d in (1, -1)}
    return by_edge


def transformed(
    model: Machine, chunk: FloatArray, timings: Timings, compliance: FloatArray = NONE
) -> FloatArray:
    """The record of the machine `behind` timings: commands as these let them reach the spools.

    chunk (n, 2 + signals), SI; the commands of the split machine stand behind its columns.
    compliance (chambers,), 1/Pa: of the oil that a supply must compress.  Without
    timings it is the record as it is: a copy would be as large.
    """
    if not timings:
        return chunk
    instants = Instants.of(chunk, model.gates.max_gap_s)
    sent = [through(u, d, instants, timings) for d, u in commands(model, chunk).values()]
    record = np.column_stack([chunk, *sent])
    cut_off(record, instants)
    return _put_right(split(model), record, instants, timings, compliance)


def cut_off(record: FloatArray, instants: Instants) -> None:
    """Mark as gaps, in place, what stands so soon behind one that nobody knows what acted there.

    record (n, 2 + signals), SI.  With 0.15 s lost each second a delay of 20 ms left 21 times the
    noise, and a leak beside it had no name.
    """
    record[instants.unknown, 1] = record[instants.unknown, 1].astype(np.int64) | GAP


def _put_right(
    model: Machine, chunk: FloatArray, instants: Instants, timings: Timings, compliance: FloatArray
) -> FloatArray:
    """The record of the split machine, its sensors and its supply as the timings have them.

    chunk (n, 2 + signals), SI: changed in place.
    """
    dt_s = instants.step_s
    if lag_s := behind_s(timings):
        behind = chunk[:, 2 + model.column(model.measured)]
        chunk[:, 2 + model.column(model.position)] += lag_s * behind
    for timing, psi in timings:
        if timing.of_sensor and not model.measured:
            for name in sensors_of(model, timing):
                column = 2 + model.column(name)
                runs = np.split(chunk[:, column], _gaps(chunk, dt_s))
                chunk[:, column] = np.concatenate([timing.apply(r, dt_s, psi) for r in runs])
                if name == model.position:
                    _measured_before(chunk, instants, psi[0])
    for timing, psi in timings:
        if timing.where == SUPPLY:
            view = RecordView.without_map(model, chunk, compliance)
            chunk[:, 2 + model.column(view.supply_name)] -= timing.apply(
                demand(view), view.step_s, psi
            )
    return chunk


def _measured_before(chunk: FloatArray, instants: Instants, late_s: float) -> None:
    """Mark positions where they were measured, late_s before they came, in place.

    Where they are slower than the record they stand on lines between, and a row at the instant of
    one that came would be a chord: of 10 ms, positions each 20 ms, 10.5 +- 1.4 at 6.8 of the noise.
    """
    flags = chunk[:, 1].astype(np.int64)
    rows = np.flatnonzero(flags & ROW)
    if len(rows) > OFTEN * len(flags):
        return
    t_s, at_s = instants.t_s, instants.t_s[rows] - late_s
    nearest = np.searchsorted(0.5 * (t_s[1:] + t_s[:-1]), at_s)
    begun_s = t_s[np.append(0, instants.starts)][np.searchsorted(instants.starts, rows, "right")]
    chunk[:, 1] = flags & ~ROW
    chunk[nearest[at_s > begun_s - 0.5 * instants.step_s], 1] += ROW


def _gaps(chunk: FloatArray, dt_s: float) -> IntArray:
    """Rows of a chunk (n, 2 + signals), SI, before which samples are missing, dt_s: usual step."""
    steps = np.diff(chunk[:, 0], prepend=chunk[0, 0])
    marked = chunk[:, 1].astype(np.int64) & GAP != 0
    return np.flatnonzero(marked & (steps > GAP_STEPS * dt_s))


def through(u: FloatArray, direction: int, instants: Instants, timings: Timings) -> FloatArray:
    """What timings let through of a command (n,), V, to the edges of one direction."""
    return instants.over(u, lambda even: _through(even, direction, instants.even_s, timings))


def _through(u: FloatArray, direction: int, dt_s: float, timings: Timings) -> FloatArray:
    for timing, psi in timings:
        if timing.where == COMMAND:
            u = timing.on(u, direction, dt_s, psi)
    return u


def slowed(u: FloatArray, instants: Instants, lag_s: float) -> FloatArray:
    """A command (n,) behind a lag of the spools, s, as the mean over each interval."""
    if lag_s == 0.0:
        return u
    return instants.over(u, lambda even: lagged(even, instants.even_s, (lag_s,)))


def change_of(
    u: FloatArray, direction: int, instants: Instants, timings: Timings, k: int, j: int
) -> FloatArray:
    """How the command at the spool follows parameter j of timing k, those behind it held.

    u (n,): the command as sent, V; result (n,): V per SI unit of the parameter.
    """
    dt_s, (timing, psi) = instants.even_s, timings[k]

    def change(even: FloatArray) -> FloatArray:
        rise = timing.change(_through(even, direction, dt_s, timings[:k]), direction, dt_s, psi, j)
        for behind, command in timings[k + 1 :]:  # linear ones pass it on, play lets it through
            if behind.where == COMMAND and behind.is_linear:
                rise = behind.apply(rise, dt_s, command)
        return rise

    return instants.over(u, change)
