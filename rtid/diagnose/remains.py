"""What a residual follows, and in which words that is said: for what no known effect explains."""

from __future__ import annotations

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
from rtid.model import Machine
from rtid.plain import FloatArray

FOLLOWS = 0.05  # of the residual's variance that a signal must explain to be named
MOST_NAMED = 3
LARGER = 1.5  # times its size the other way: then the direction is named
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
    part = residual(fit, fit.chunk)
    if not len(part.t_s):
        return (NEXT,)
    beside = filtered(fit.declared, part, fit.chunk)
    return f"{_where(fit.declared, beside)} {_what(fit.declared, beside)}", NEXT


def _where(model: Machine, beside: Comparison) -> str:
    """The chamber in which most is left, as a share of its flow, and the direction of motion."""
    rest = np.sqrt(np.mean(beside.residual_m3s**2, axis=0))
    share = rest / np.maximum(beside.flow_rms_m3s, 1e-12)
    c = int(np.argmax(share))
    text = f"Most is left in chamber {model.chambers[c].name}, {100 * share[c]:.2g} % of its flow"
    ways = by_direction(model, beside)
    size = dict.fromkeys(DIRECTIONS, 0.0)
    for low, rms in zip(ways.low, ways.rms_m3s[:, c], strict=True):
        size[_way(low)] = float(rms)
    positive, other = size[DIRECTIONS[0]], size[DIRECTIONS[-1]]
    if min(positive, other) > 0.0 and max(positive, other) > LARGER * min(positive, other):
        text += f", above all while {DIRECTIONS[0] if positive > other else DIRECTIONS[-1]}"
    return f"{text}."


def _way(low: float) -> str:
    """The direction of a bin that begins at this speed."""
    return DIRECTIONS[0] if low == -np.inf else DIRECTIONS[1 if low < 0.0 else 2]


def _what(model: Machine, beside: Comparison) -> str:
    """The signals that the residual follows most."""
    dependences = [*against_signals(model, beside), over_time(beside)]
    dependences.sort(key=lambda d: -float(d.explained.max()))
    named = [_named(d) for d in dependences[:MOST_NAMED] if d.explained.max() > FOLLOWS]
    if named:
        return f"It follows {', '.join(named)} of its variance."
    return (
        "It follows none of the signals at the same instant: look for something quick (a delay, a "
        "line), or for a quantity that is not measured."
    )


def _named(depends: Dependence) -> str:
    name = "the time" if depends.signal == TIME else depends.signal
    return f"{name} with {100 * float(depends.explained.max()):.0f} %"
