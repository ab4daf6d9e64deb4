"""What a residual follows, and in which words that is said: for what no known effect explains.

Which signal, when, in which direction of motion, and at which frequency: over pieces without a gap,

    mean square in a band = sum over pieces n sum over f in the band |X_f|^2 / sum over pieces n.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.compare.comparison import Comparison, Intervals
from rtid.compare.dependence import (
    DIRECTIONS,
    TIME,
    Dependence,
    against_signals,
    by_direction,
    over_time,
)
from rtid.diagnose.fit import Fit
from rtid.diagnose.residual import Residual, residual
from rtid.diagnose.verdict import can_judge
from rtid.model import Machine
from rtid.plain import FloatArray

FOLLOWS = 0.05  # of the residual's variance that a signal must explain to be named
MOST_NAMED = 3
FOLLOWS_NONE = "It follows none of the signals"
LARGER = 1.5  # times its size the other way: then the direction is named
BURST = 2.0  # times the size over the record: then the span of time is named
BANDS_HZ = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, np.inf)
MOST = 0.5  # of what is left beyond the noise, in one band or two beside each other
GAP = 1.5  # periods between rows that are no gap
NEXT = (
    "Next: `rtid compare` shows where and when it is largest.  Repeat the motion that shows it "
    "slowly and fast, with another load: what changes with the speed is a flow or a delay, what "
    "changes with the pressure a leak or what a chamber stores.  An effect of your own goes into "
    "the project file as a formula."
)


def filtered(model: Machine, part: Residual, chunk: FloatArray) -> Comparison:
    """A residual beside the signals of its record, chunk (n, 2 + signals), SI, for `Dependence`."""
    by = model.filter
    at_s = part.t_s - 2 * by.zeta / by.wn_rad_s  # the filter's delay at low frequencies
    values = [np.interp(at_s, chunk[:, 0], chunk[:, 2 + j]) for j in range(len(model.signals))]
    empty = np.empty((0, len(model.chambers)))
    return Comparison(
        name="",
        t_s=part.t_s,
        measured_m3s=part.measured,
        modelled_m3s=part.measured - part.left,
        cell=np.zeros((len(part.t_s), len(model.edges)), np.int64),
        shares={},
        rho=np.ones(len(model.chambers)),
        signals=np.stack(values, axis=1),
        intervals=Intervals(part.t_s[:0], np.zeros((0, 0), np.int64), empty, empty, empty),
    )


def described(fit: Fit) -> tuple[str, ...]:
    """What the residual of a fit follows in its own record, and what to do next."""
    shown = remainder(fit)
    return (NEXT,) if shown is None else (shown.text, NEXT)


@dataclass(frozen=True)
class Remainder:
    """What a model leaves of its record: where, when, at which frequency, in which direction.

    signals: the dependences by what they explain, the most first; rms_m3s, noise_m3s (bands,
    chambers): what is left in each of BANDS_HZ, and what the sensors' noise leaves there.
    """

    text: str
    chambers: tuple[str, ...]
    signals: tuple[Dependence, ...]
    time: Dependence
    direction: Dependence
    rms_m3s: FloatArray
    noise_m3s: FloatArray


def remainder(fit: Fit) -> Remainder | None:
    """What the residual of a fit is like in its own record; None where nothing can be judged.

    Where the map is known over next to nothing of it, it is that of all of the record that is on
    its grid: nine rows, of a choking valve, said nothing of flow in bursts.
    """
    part, model = residual(fit, fit.chunk), fit.declared
    if not can_judge(part):
        part = residual(fit, fit.chunk, everywhere=True)
    if not len(part.t_s):
        return None
    beside = filtered(model, part, fit.chunk)
    signals = sorted(against_signals(model, beside), key=lambda d: -float(d.explained.max()))
    rest = np.sqrt(np.mean(beside.residual_m3s**2, axis=0))
    share = rest / np.maximum(beside.flow_rms_m3s, 1e-12)
    c = int(np.argmax(share))
    time, ways = over_time(beside), by_direction(model, beside)
    sizes = bands(part.t_s, part.left), bands(part.t_s, part.noise)
    where = f"Most is left in chamber {model.chambers[c].name}, {100 * share[c]:.2g} % of its flow"
    words = f"{where}{_way(ways, c)}{_when(time, c)}{_how_fast(*(size[:, c] for size in sizes))}."
    names = tuple(chamber.name for chamber in model.chambers)
    text = f"{words} {_what([*signals, time])}"
    return Remainder(text, names, tuple(signals), time, ways, *sizes)


def bands(t_s: FloatArray, values: FloatArray) -> FloatArray:
    """Root mean square of rows (rows, c) in each of BANDS_HZ: (bands, c); t_s (rows,)."""
    square = np.zeros((len(BANDS_HZ) - 1, values.shape[1]))
    steps = np.diff(t_s)
    period = float(np.median(steps)) if len(steps) else 1.0
    for piece in np.split(values, 1 + np.flatnonzero(steps > GAP * period)):
        n = len(piece)
        power = np.abs(np.fft.rfft(piece, axis=0)) ** 2 / n
        power[1 : (n + 1) // 2] *= 2.0  # of both signs
        square += _shares(np.arange(len(power)) / (n * period), 0.5 / (n * period)).T @ power
    return np.sqrt(square / max(len(values), 1))


def _shares(f_hz: FloatArray, half_hz: float) -> FloatArray:
    """How much of each line of a spectrum, which is 2 half_hz wide, lies in each of BANDS_HZ."""
    low, high = np.maximum(f_hz - half_hz, 0.0)[:, None], (f_hz + half_hz)[:, None]
    inside = np.minimum(high, BANDS_HZ[1:]) - np.maximum(low, BANDS_HZ[:-1])
    return np.asarray(np.maximum(inside, 0.0) / (high - low))


def _way(ways: Dependence, c: int) -> str:
    """The direction of motion in which most is left, where it is one."""
    size = dict.fromkeys(DIRECTIONS, 0.0)
    for low, rms in zip(ways.low, ways.rms_m3s[:, c], strict=True):
        size[_direction(low)] = float(rms)
    positive, other = size[DIRECTIONS[0]], size[DIRECTIONS[-1]]
    if min(positive, other) > 0.0 and max(positive, other) > LARGER * min(positive, other):
        return f", above all while {DIRECTIONS[0] if positive > other else DIRECTIONS[-1]}"
    return ""


def _direction(low: float) -> str:
    """The direction of a bin that begins at this speed."""
    return DIRECTIONS[0] if low == -np.inf else DIRECTIONS[1 if low < 0.0 else 2]


def _when(time: Dependence, c: int) -> str:
    """The span of time in which most is left, where it stands out."""
    size = time.rms_m3s[:, c]
    if not len(size):  # too few rows for any
        return ""
    k = int(np.argmax(size))
    usual = np.sqrt(np.average(size**2, weights=time.rows))
    if not size[k] > BURST * usual:
        return ""
    return f", most from {time.low[k]:.3g} to {time.high[k]:.3g} s"


def _how_fast(rms: FloatArray, noise: FloatArray) -> str:
    """The band of frequencies that holds most of what is beyond the noise, or two that do."""
    beyond = np.maximum(rms**2 - noise**2, 0.0)
    total = float(beyond.sum())
    for width in (1, 2):
        sums = np.convolve(beyond, np.ones(width), "valid")
        k = int(np.argmax(sums))
        if total > 0.0 and sums[k] > MOST * total:
            return f", {100 * sums[k] / total:.0f} % of it {band_name(k, k + width)}"
    return ", at no frequency of its own"


def band_name(low: int, high: int) -> str:
    """The frequencies from one of BANDS_HZ to another, in words."""
    ends = BANDS_HZ[low], BANDS_HZ[high]
    if not low:
        return f"below {ends[1]:g} Hz"
    return f"above {ends[0]:g} Hz" if ends[1] == np.inf else f"at {ends[0]:g} to {ends[1]:g} Hz"


def _what(dependences: list[Dependence]) -> str:
    """The signals that the residual follows most."""
    dependences.sort(key=lambda d: -float(d.explained.max()))
    named = [_named(d) for d in dependences[:MOST_NAMED] if d.explained.max() > FOLLOWS]
    if named:
        return f"It follows {', '.join(named)} of its variance."
    return (
        f"{FOLLOWS_NONE} at the same instant: look for something quick (a delay, a "
        "line), or for a quantity that is not measured."
    )


def _named(depends: Dependence) -> str:
    name = "the time" if depends.signal == TIME else depends.signal
    return f"{name} with {100 * float(depends.explained.max()):.0f} %"
