"""Which one thing would make a map foretell the motion again: a sensor, a leak, air.

Each suspect changes the samples, or adds a flow, by a size.  That is fitted by Gauss-Newton steps
to the residual of the map, together with what a healthy day may change; then the map is held
against the changed samples as it was against the measured ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from rtid.compare.candidate import CandidateMap
from rtid.compare.comparison import compare
from rtid.compare.foretelling import (
    Residuals,
    in_motion,
    rated_m3s,
    residuals,
    seconds,
    sigma_m3s,
)
from rtid.model import COMMAND, POSITION, PRESSURE, Chamber, Machine
from rtid.plain import FloatArray

ATMOSPHERE_PA = 101_325.0
LEAST_PA = 1e4  # below, air would be all there is
MOST_S = 20.0  # of samples that the suspects are tried on
MENDS = 0.5  # share of the residual that a suspect must take away
AS_GOOD = 1.5  # times what the best one leaves: not to be told from it
MOST = 3
SCALE, OFFSET = 0.5, 0.3  # bounds: relative; share of the signal's span, at least MOST_OFFSET_PA
STEPS = 2

Changed = tuple[FloatArray, FloatArray | None]  # samples, and flow into the chambers


@dataclass(frozen=True)
class Suspect:
    """change(chunk, size): the samples as they should be; bounds of the size, and a small one.

    step = 0: there is nothing to fit.  say(size): in words.  of_sensor: not of the machine.
    """

    change: Callable[[FloatArray, float], Changed]
    say: Callable[[float], str]
    bounds: tuple[float, float]
    step: float
    of_sensor: bool = True


@dataclass(frozen=True)
class LikelyCause:
    """A suspect that would mend the map: in words, and the residual beside it, in sigma."""

    text: str
    left: float
    of_sensor: bool


def causes(
    model: Machine, candidate: CandidateMap, chunk: FloatArray, level: FloatArray
) -> list[LikelyCause]:
    """Up to MOST causes that mend the residual about equally well, the best first; or none.

    chunk (n, 2 + signals) in SI; level (chambers,), m3/s: as of `foretelling.level_of`.
    """
    chunk = chunk[chunk[:, 0] >= chunk[-1, 0] - MOST_S]
    trial = _Trial(model, candidate, chunk, level)
    tried = [cause for suspect in suspects(model, chunk) if (cause := trial.of(suspect))]
    tried = sorted(tried, key=lambda cause: cause.left)
    if not tried or tried[0].left > MENDS * trial.unmended:
        return []
    return [cause for cause in tried if cause.left <= AS_GOOD * tried[0].left][:MOST]


class _Trial:
    """The samples that all suspects are tried on."""

    def __init__(
        self, model: Machine, candidate: CandidateMap, chunk: FloatArray, level: FloatArray
    ) -> None:
        self._model, self._candidate, self._chunk = model, candidate, chunk
        self._level, self._sigma = level, sigma_m3s(model, level)
        self._rows = residuals(model, candidate, chunk)
        self.unmended = self._left(self._rows)

    def of(self, suspect: Suspect) -> LikelyCause | None:
        """What the suspect leaves, or None where it says nothing of these samples."""
        size = 0.0
        rows = self._rows
        for _ in range(STEPS if suspect.step else 0):
            size = self._better(suspect, size, rows)
            rows = self._with(suspect, size)
        if not suspect.step:
            rows = self._with(suspect, 1.0)
        rest = self._left(rows)
        return (
            LikelyCause(suspect.say(size), rest, suspect.of_sensor) if np.isfinite(rest) else None
        )

    def _with(self, suspect: Suspect, size: float) -> Residuals:
        chunk, flow = suspect.change(self._chunk, size)
        if flow is None:
            return residuals(self._model, self._candidate, chunk)
        plain = residuals(self._model, self._candidate, chunk)
        return replace(plain, residual=plain.residual - self._added(chunk, flow, plain.t_s))

    def _added(self, chunk: FloatArray, flow: FloatArray, t_s: FloatArray) -> FloatArray:
        """What a flow adds to the modelled side, at rows."""
        with_flow = compare(self._model, self._candidate, chunk, flow)
        without = compare(self._model, self._candidate, chunk)
        at = np.searchsorted(without.t_s, t_s)
        return np.asarray((with_flow.modelled_m3s - without.modelled_m3s)[at])

    def _better(self, suspect: Suspect, size: float, rows: Residuals) -> float:
        """One step of Gauss-Newton."""
        from scipy.optimize import lsq_linear  # noqa: PLC0415 - takes long to import

        low, high = suspect.bounds
        step = suspect.step if size + suspect.step <= high else -suspect.step
        chunk, flow = suspect.change(self._chunk, size + step)
        moved = compare(self._model, self._candidate, chunk, flow)
        at = np.clip(np.searchsorted(moved.t_s, rows.t_s), 0, max(0, len(moved.t_s) - 1))
        if not len(moved.t_s) or not len(rows.t_s):
            return size
        same = (
            rows.known
            & (moved.t_s[at] == rows.t_s)
            & np.isfinite(moved.residual_m3s[at]).all(axis=1)
        )
        column = (rows.residual - moved.residual_m3s[at]) / step
        columns = np.concatenate([rows.columns, column[..., None]], axis=-1)[same]
        if not len(columns):
            return size
        scale = np.array([*np.ones(columns.shape[-1] - 1), abs(step)])
        matrix = (columns * scale / self._sigma[:, None]).reshape(-1, len(scale))
        limits = np.ones(len(scale))
        lower = np.array([*-limits[:-1], (low - size) / abs(step) - 1e-9])
        upper = np.array([*limits[:-1], (high - size) / abs(step) + 1e-9])
        right = (rows.residual[same] / self._sigma).reshape(-1)
        return size + float(lsq_linear(matrix, right, (lower, upper)).x[-1]) * abs(step)

    def _left(self, rows: Residuals) -> float:
        """Mean over the seconds of the root mean square, in sigma."""
        judged = seconds(self._model, in_motion(self._model, rows), self._level)
        return float(np.sqrt(judged.squares.mean(axis=1)).mean()) if len(judged.t_s) else np.inf


def suspects(model: Machine, chunk: FloatArray) -> Iterator[Suspect]:
    """All that can be tried on these samples, chunk (n, 2 + signals) in SI."""
    for signal in model.signals:
        column = 2 + model.column(signal.name)
        span = float(np.ptp(chunk[:, column]))
        if span == 0.0:  # a constant
            continue
        if signal.kind in (PRESSURE, POSITION):
            yield _scaled(signal.name, column)
            yield _shifted(signal.name, column, max(OFFSET * span, 0.0), signal.unit)
        if signal.kind in (COMMAND, POSITION):
            # the stroke is not known here: a position is turned about where the machine works
            is_position = signal.kind == POSITION
            middle = float(chunk[:, column].min()) + 0.5 * span if is_position else 0.0
            yield _reversed(signal.name, column, middle)
        if signal.kind == COMMAND:
            yield _shifted(signal.name, column, OFFSET * span, signal.unit)
    yield from _swapped(model)
    yield from _flows(model, chunk)


def _scaled(name: str, column: int) -> Suspect:
    def change(chunk: FloatArray, size: float) -> Changed:
        changed = chunk.copy()
        changed[:, column] *= 1 + size
        return changed, None

    def say(size: float) -> str:
        much = 1 / (1 + size) - 1
        return f"{name} reads {100 * abs(much):.3g} % too {'much' if much > 0 else 'little'}"

    return Suspect(change, say, (-SCALE, SCALE), 0.01)


def _shifted(name: str, column: int, most: float, unit: str) -> Suspect:
    def change(chunk: FloatArray, size: float) -> Changed:
        changed = chunk.copy()
        changed[:, column] += size
        return changed, None

    def say(size: float) -> str:
        factor, shown = (1e-5, "bar") if unit == "Pa" else (1.0, unit)
        much = "little" if size > 0 else "much"
        return f"{name} reads {factor * abs(size):.3g} {shown} too {much}"

    return Suspect(change, say, (-most, most), 0.02 * most)


def _reversed(name: str, column: int, middle: float) -> Suspect:
    def change(chunk: FloatArray, _size: float) -> Changed:
        changed = chunk.copy()
        changed[:, column] = 2 * middle - chunk[:, column]
        return changed, None

    return Suspect(change, lambda _: f"{name} has the wrong sign", (0.0, 0.0), 0.0)


def _swapped(model: Machine) -> Iterator[Suspect]:
    names = [chamber.pressure for chamber in model.chambers if chamber.pressure]
    for k, item in enumerate(names):
        for other in names[k + 1 :]:
            yield _pair(item, other, 2 + model.column(item), 2 + model.column(other))


def _pair(item: str, other: str, first: int, second: int) -> Suspect:
    def change(chunk: FloatArray, _size: float) -> Changed:
        changed = chunk.copy()
        changed[:, [first, second]] = chunk[:, [second, first]]
        return changed, None

    return Suspect(change, lambda _: f"{item} and {other} are swapped", (0.0, 0.0), 0.0)


def _flows(model: Machine, chunk: FloatArray) -> Iterator[Suspect]:
    """Leaks and air: flows that the pressures make."""
    chambers = [c for c in model.chambers if c.pressure]
    drop = max((float(np.abs(_mean(model, chunk, c)).mean()) for c in chambers), default=0.0)
    if not drop > 0.0:
        return
    most = 5.0 * rated_m3s(model) / drop
    for k, chamber in enumerate(chambers):
        yield _leak(model, (chamber,), most)
        for other in chambers[k + 1 :]:
            yield _leak(model, (chamber, other), most)
    if chambers and all(float(chunk[:, _at(model, c)].min()) > LEAST_PA for c in chambers):
        yield _air(model, chambers)


def _at(model: Machine, chamber: Chamber) -> int:
    return 2 + model.column(chamber.pressure)


def _mean(model: Machine, chunk: FloatArray, chamber: Chamber) -> FloatArray:
    """Mean pressure over each interval (n - 1,)."""
    p = chunk[:, _at(model, chamber)]
    return np.asarray(0.5 * (p[1:] + p[:-1]))


def _leak(model: Machine, ends: tuple[Chamber, ...], most: float) -> Suspect:
    """From a chamber to tank, or to the other one."""

    def change(chunk: FloatArray, size: float) -> Changed:
        drop = _mean(model, chunk, ends[0])
        drop = drop - _mean(model, chunk, ends[1]) if len(ends) > 1 else drop
        flow = np.zeros((len(drop), len(model.chambers)))
        for chamber, sign in zip(ends, (-1.0, 1.0), strict=False):
            flow[:, model.chambers.index(chamber)] = sign * size * drop
        return chunk, flow

    def say(size: float) -> str:
        where = " to ".join(chamber.name for chamber in ends) if len(ends) > 1 else ends[0].name
        rate = 6e4 * 1e6 * size
        return f"a leak {'from ' if len(ends) > 1 else 'out of '}{where}, {rate:.3g} L/min per MPa"

    return Suspect(change, say, (0.0, most), 0.002 * most, of_sensor=False)


def _air(model: Machine, chambers: list[Chamber]) -> Suspect:
    """Isothermal air in all chambers: -phi V d(-p0 / P)/dt."""

    def change(chunk: FloatArray, size: float) -> Changed:
        x = chunk[:, 2 + model.column(model.position)]
        flow = np.zeros((len(chunk) - 1, len(model.chambers)))
        dt = np.maximum(np.diff(chunk[:, 0]), 1e-9)
        for chamber in chambers:
            volume = chamber.volume(0.5 * (x[1:] + x[:-1]))
            rate = np.diff(-ATMOSPHERE_PA / chunk[:, _at(model, chamber)]) / dt
            flow[:, model.chambers.index(chamber)] = -size * volume * rate
        return chunk, flow

    def say(size: float) -> str:
        return f"air in the oil, {100 * size:.2g} % of its volume at atmospheric pressure"

    return Suspect(change, say, (0.0, 0.3), 0.005, of_sensor=False)
