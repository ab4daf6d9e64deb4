"""Effects between the command and the spool: the command that the map should have been given.

A command u_k is held over [t_k, t_k+1]; a transformed one is the mean over that interval of what
reaches the spool, and is held in its place.  Edges that open with u > 0 and with u < 0 may be parts
of one spool, which follows the signed command, or valves of their own, each of which follows its
part of the command and rests at zero meanwhile: so there is one command for either direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from rtid.effects.filtering import filtered, held_second_order
from rtid.effects.page import catalogue
from rtid.kernels.jit import kernel
from rtid.model import COMMAND as SENT
from rtid.model import Machine
from rtid.plain import FloatArray

Psi = tuple[float, ...]
COMMAND, SUPPLY = "command", "supply"  # what a timing transforms; else a sensor at its place
COMMAND_RATE = "V/s"
RATES = "rad/s", COMMAND_RATE  # units of a parameter that does the more the smaller it is
SHUT = 2e-3  # of the largest command, from which an opening counts for one
OF_TIME = "s", "rad/s"  # of one that is sought among others where samples are far apart
LAG_S, MOST_RATE, SWING = "time_constant", "rate", ("natural_frequency", "damping")
DEAD_BAND = "dead_band"  # behind which a lag may sit
USUAL_STEP_S = 0.01  # up to which the banks are those of the pages
OF_COMMAND = "V", COMMAND_RATE  # units on the pages of what is in a command's
USUAL_COMMAND = 10.0  # the largest command of the pages, V
ALIKE = 2.0  # times the usual largest, up to which the banks are those of the pages
# for which a command goes on as far: a limit that it outruns for so long is worth looking for
OUTRUN_S = 0.012, 0.03, 0.075, 0.19, 0.47
AT_BOUND = 1.01  # times a bound, within which a parameter is at it


@dataclass(frozen=True)
class TimingLaw:
    """A transformation of the command with parameters psi; `bank`: where a search starts.

    apply(u (n,), dt_s, psi) -> (n,); low, high: bounds of psi; replaces_lag: it stands for the
    declared lag of the spools instead of coming before it; is_linear: in the command;
    own_spools: each direction follows its own part of the command; where: a command, the
    demand on the supply, from which `apply` makes what the supply gives way, or the place of a
    sensor; is_rate: psi[0] is a
    rate, so that a smaller one does more.
    """

    effect: str
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    bank: tuple[Psi, ...]
    low: Psi
    high: Psi
    apply: Callable[[FloatArray, float, Psi], FloatArray]
    replaces_lag: bool = False
    is_linear: bool = True
    own_spools: bool = False
    where: str = COMMAND
    is_rate: bool = False

    def is_at(self, effect: str, where: str) -> bool:
        """True for the timing of that name and place."""
        return self.effect == effect and self.where in (COMMAND, SUPPLY, where)

    @property
    def is_limit(self) -> bool:
        """True where a little more of it than there is costs far more than all that it explains."""
        return self.apply is rate_limited

    @property
    def is_within_lag(self) -> bool:
        """True for a form that has the lag of the spools in it, beside one that comes before it."""
        return self.replaces_lag and self.is_limit

    @property
    def of_sensor(self) -> bool:
        """True where it puts a measurement right."""
        return self.where not in (COMMAND, SUPPLY)

    def at_step(self, step_s: float) -> TimingLaw:
        """The same for a record of longer steps than a controller's: its times are so much longer.

        step_s: usual step of the record.  A time below a fraction of it shows nothing.
        """
        times = step_s / USUAL_STEP_S
        if times <= 1.0 or self.units[0] not in OF_TIME:
            return self
        by = 1.0 / times if self.is_rate else times

        def longer(psi: Psi) -> Psi:
            return (by * psi[0], *psi[1:])

        bank = tuple(longer(psi) for psi in self.bank)
        low, high = longer(self.low), longer(self.high)
        return replace(self, bank=bank, low=min(self.low, low), high=max(self.high, high))

    def at_command(self, times: float) -> TimingLaw:
        """The same for commands so many times as large as the pages': `command_times`."""
        by = [times if unit in OF_COMMAND else 1.0 for unit in self.units]
        if all(k == 1.0 for k in by):
            return self

        def wider(psi: Psi) -> Psi:
            return tuple(k * value for k, value in zip(by, psi, strict=True))

        bank = tuple(wider(psi) for psi in self.bank)
        return replace(self, bank=bank, low=wider(self.low), high=wider(self.high))

    def for_record(self, model: Machine, chunk: FloatArray) -> TimingLaw:
        """The same for a record: a limit of a rate is looked for where its commands outrun it.

        chunk (n, 2 + signals), SI.
        """
        if not self.is_limit:
            return self
        rates = {r for r in outrun_rates(model, chunk) if self.low[0] < r < self.high[0]}
        bank = tuple((r, *self.bank[0][1:]) for r in sorted(rates))
        return replace(self, bank=bank or self.bank)

    def beside_lag(self, lag_s: float) -> TimingLaw:
        """A limit within the lag of the spools, looked for beside so much of it, s."""
        lag = max(lag_s, self.low[1])
        return replace(self, bank=tuple((psi[0], lag) for psi in self.bank))

    def is_free(self, psi: Psi, k: int) -> bool:
        """True where parameter k is not at a bound."""
        return AT_BOUND * self.low[k] < psi[k] < self.high[k] / AT_BOUND

    def is_least(self, psi: Psi) -> bool:
        """True where it does no more than any timing of its kind must."""
        if self.is_rate:
            return psi[0] >= self.high[0] / AT_BOUND
        return psi[0] <= AT_BOUND * self.low[0]

    def strength(self, psi: Psi) -> float:
        """How much a command is changed, 0 for not at all."""
        return 1.0 / psi[0] if self.is_rate else psi[0]

    def at(self, strength: float) -> Psi:
        """The parameters of that strength, within their bounds, the others as in the bank."""
        value = 1.0 / strength if self.is_rate else strength
        return (float(np.clip(value, self.low[0], self.high[0])), *self.bank[0][1:])

    def on(self, command: FloatArray, direction: int, dt_s: float, psi: Psi) -> FloatArray:
        """What reaches the spool of the edges of one direction (+1, -1)."""
        if self.own_spools:
            command = direction * np.maximum(0.0, direction * command)
        return self.apply(command, dt_s, psi)

    def change(
        self, command: FloatArray, direction: int, dt_s: float, psi: Psi, k: int
    ) -> FloatArray:
        """Derivative (n,) of the transformed command with respect to psi[k], by differences."""
        step = 0.02 * max(abs(psi[k]), 0.02 * abs(self.bank[0][k]))
        above, below = list(psi), list(psi)
        above[k], below[k] = min(psi[k] + step, self.high[k]), max(psi[k] - step, self.low[k])
        wide = above[k] - below[k]
        rise = self.on(command, direction, dt_s, tuple(above))
        rise -= self.on(command, direction, dt_s, tuple(below))
        return np.asarray(rise / wide)


def delayed(u: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """u(t - psi) (n,), mean over each interval, in the unit of u."""
    steps = max(0.0, psi[0]) / dt_s
    whole = int(steps)
    part = steps - whole
    padded = np.concatenate([np.full(whole + 1, u[0]), u])
    n = len(u)
    return np.asarray((1.0 - part) * padded[1 : n + 1] + part * padded[:n])


def lagged(u: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """First-order lag of time constant psi, mean over each interval (n,), exact where u is held."""
    tau = max(psi[0], 1e-9)
    fade = float(np.exp(-dt_s / tau))
    start = filtered((0.0, 1.0 - fade, 0.0), (1.0, -fade, 0.0), u - u[0]) + u[0]
    return np.asarray(u + (start - u) * tau / dt_s * (1.0 - fade))


def second_order(u: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """Spool of natural frequency psi[0] rad/s and damping psi[1], mean over each interval (n,)."""
    wn, zeta = psi
    start = filtered(*held_second_order(wn, zeta, dt_s), u - u[0]) + u[0]
    return np.asarray(0.5 * (start + np.append(start[1:], start[-1])))


def behind_opening(
    u: FloatArray, dead_v: float, follow: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """What follows behind the opening curve, mean over each interval (n,), in the unit of u.

    What is beyond the dead band follows, and is added to it again: a valve that is told to shut
    still closes while the command is inside.  u (n,), V: of one sign; follow: of what is beyond it,
    which rests at 0 where it swings below.
    """
    size = np.abs(u)
    opening = np.maximum(follow(np.maximum(size - dead_v, 0.0)), 0.0)
    shut = max(SHUT * float(size.max()), 1e-300)
    inside = np.maximum(dead_v - size, 0.0) * np.exp(-opening / shut)
    out = dead_v - inside + opening
    return np.asarray(np.copysign(out, u.min() if -u.min() > u.max() else 1.0))


def lagged_opening(u: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """A lag behind the opening curve (n,), V: time constant, dead band."""
    tau_s, dead_v = psi
    return behind_opening(u, dead_v, lambda opening: lagged(opening, dt_s, (tau_s,)))


def second_order_opening(u: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """A valve of second order behind its opening curve (n,), V: frequency, damping, dead band."""
    wn, zeta, dead_v = psi
    return behind_opening(u, dead_v, lambda opening: second_order(opening, dt_s, (wn, zeta)))


def played(u: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """u (n,) behind a play of full width psi: the spool follows once the play is taken up."""
    out = np.empty(len(u))
    _play(np.ascontiguousarray(u), 0.5 * psi[0], out)
    return out


@kernel
def _play(u: FloatArray, half: float, out: FloatArray) -> None:
    at = u[0]
    for k in range(len(u)):
        at = min(max(at, u[k] - half), u[k] + half)
        out[k] = at


def rate_limited(u: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """What follows u (n,) at no more than a rate psi[0], V/s: mean over each interval (n,), exact.

    ds/dt = clip((u - s) / tau, -r, r), of a lag tau = psi[1]; without one s is at u once it has
    come there.  Where it is outrun since t_0, ds/dr = sign(u - s) (t - t_0); else r does nothing.
    """
    rate, tau = psi if len(psi) > 1 else (psi[0], 0.0)
    out = np.empty(len(u))
    _follow(np.ascontiguousarray(u), dt_s, rate, tau, out)
    return out


@kernel
def _follow(u: FloatArray, dt: float, rate: float, tau: float, out: FloatArray) -> None:
    at, near = u[0], rate * tau
    for k in range(len(u)):
        way = u[k] - at
        far = max(abs(way) - near, 0.0)
        straight = min(dt, far / rate)  # as fast as it may, then as the lag has it
        moved = math.copysign(rate * straight, way)
        left, rest = way - moved, dt - straight
        faded = math.exp(-rest / tau) if tau > 0.0 else 0.0
        if rest <= 0.0:
            faded = 1.0
        behind = (way - 0.5 * moved) * straight + left * tau * (1.0 - faded)
        out[k] = u[k] - behind / dt
        at = u[k] - left * faded


def outrun_rates(model: Machine, chunk: FloatArray) -> set[float]:
    """The fastest that a command goes on for each of OUTRUN_S, V/s; chunk (n, 2 + signals), SI."""
    step_s = float(np.median(np.diff(chunk[:, 0]))) if len(chunk) > 1 else 0.0
    spans = {max(1, round(span_s / step_s)) for span_s in OUTRUN_S} if step_s > 0.0 else set()
    columns = {2 + model.column(edge.command) for edge in model.edges}
    return {
        max(float(np.abs(chunk[m:, c] - chunk[:-m, c]).max()) for c in columns) / (m * step_s)
        for m in spans
        if m < len(chunk)
    }


def of_law(
    law: str, apply: Callable[[FloatArray, float, Psi], FloatArray], names: tuple[str, ...] = (),
    **keys: Any,
) -> TimingLaw:  # fmt: skip
    """The timing of the page that names this law, with its parameters.

    names: in another order, or some of them.

    apply: (n,) to (n,), both in V, or of a demand in m3/s to Pa.
    """
    (page,) = (page for page in catalogue().values() if page.law == law)
    known = {p.name: p for p in page.parameters}
    parameters = tuple(known[name] for name in names or known)
    return TimingLaw(
        page.name,
        tuple(p.name for p in parameters),
        tuple(p.unit for p in parameters),
        tuple(product(*(p.start for p in parameters))),
        tuple(p.low for p in parameters),
        tuple(p.high for p in parameters),
        apply,
        is_rate=parameters[0].unit in RATES,
        **keys,
    )


COMMAND_LAWS: dict[str, tuple[TimingLaw, ...]] = {
    "delay": (of_law("delay", delayed),),
    "lag": (
        *(of_law("lag", lagged, (LAG_S,), own_spools=its_own) for its_own in (False, True)),
        of_law("lag", lagged_opening, (LAG_S, DEAD_BAND), own_spools=True, is_linear=False),
    ),
    "second_order": (
        *(
            of_law("second_order", second_order, SWING, replaces_lag=True, own_spools=its_own)
            for its_own in (False, True)
        ),
        of_law(
            "second_order",
            second_order_opening,
            (*SWING, DEAD_BAND),
            replaces_lag=True,
            own_spools=True,
            is_linear=False,
        ),
    ),
    "play": (of_law("play", played, is_linear=False),),
    "rate_limit": (
        of_law("rate_limit", rate_limited, (MOST_RATE,), is_linear=False),
        of_law("rate_limit", rate_limited, (MOST_RATE, LAG_S), is_linear=False, replaces_lag=True),
    ),
}
TIMINGS = tuple(timing for timings in COMMAND_LAWS.values() for timing in timings)


def timings_of(model: Machine, chunk: FloatArray) -> tuple[TimingLaw, ...]:
    """The timings that a command of this machine can have in a record, chunk (n, 2 + signals), SI.

    A plant without pressures has no spools of their own: its maps are over the signed command.  Nor
    is a limit of their rate told there: of an excavator's boom one day alone had one, 6.8 %/s, and
    the others a delay.  Between what is measured, a pump's speed or a piston's, and what it does
    there is no spool.
    """
    times = command_times(model)
    if not times:
        return ()
    step_s = float(np.median(np.diff(chunk[:, 0]))) if len(chunk) > 1 else 0.0
    can_be = [t for t in TIMINGS if model.has_pressures or not (t.own_spools or t.is_limit)]
    return tuple(t.at_step(step_s).at_command(times).for_record(model, chunk) for t in can_be)


def command_times(model: Machine) -> float:
    """The largest command of the maps, of the pages' 10 V; 0 of a machine that has no command.

    Whatever its unit: %, mA, or a share of 1.  Banks are three times apart, so that one of 5 to
    20 is as on the pages.
    """
    kinds = {s.name: s.kind for s in model.signals}
    sent = [np.abs(e.grid.u_v).max() for e in model.edges if kinds[e.command] == SENT]
    if not sent:
        return 0.0
    times = float(max(sent)) / USUAL_COMMAND
    return 1.0 if 1.0 / ALIKE <= times <= ALIKE else times
