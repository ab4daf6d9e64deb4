"""Candidate columns: what one unit of each effect would add to the chambers, per interval.

Every column is a volume in m3 over each interval and per chamber, for a coefficient of 1 in the
effect's SI unit, on the right-hand side of (14).  Those of storage effects also have an *echo*: the
same column of the pressures' noise alone, by which errors in variables are taken out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.signal import lfilter

from rtid import effects
from rtid.diagnose.evidence import Given
from rtid.diagnose.view import View
from rtid.estimator.state import variance
from rtid.kernels.jit import kernel
from rtid.model import Edge, FloatArray

ATMOSPHERE_PA = 101325.0
LEAST_PA = 5e4  # below, gas and vapour follow other laws: cavitation
RELIEF_LAGS_S = (0.0, 0.02, 0.06)  # own dynamics of a relief valve
OPENINGS = 8  # opening pressures of a relief or make-up valve that are tried, over the range
SAG_TIMES_S = (0.05, 0.15, 0.4, 1.2)
PUMP_FLOWS = (0.3, 0.5, 0.7, 0.85, 0.95)  # quantiles of the demand that a pump may deliver
VAPOUR_PA = (2e4, 5e4, 1e5, 1.5e5, 2e5)  # below which gas may come out of the oil
GROOVE_M = 0.03  # half length of a worn place
GROOVES = 5  # places along the stroke where a wall may be worn
SEED = 20051005  # of the noise that stands for the sensors' own

Volumes = dict[int, FloatArray]  # chamber -> (n - 1,) m3


@dataclass(frozen=True)
class Candidate:
    """One column: effect, where it sits, the parameter that its coefficient is, and its bounds.

    sign: +1 where only positive coefficients are possible, 0 either; largest: of the coefficient,
    SI; shape: the value of a nonlinear parameter that the column was made with.
    """

    effect: str
    where: str
    parameter: str
    unit: str
    largest: float
    sign: int = 1
    shape: float | None = None
    shape_name: str = ""
    shape_unit: str = ""
    lag_s: float = 0.0  # of its own dynamics

    @property
    def key(self) -> tuple[str, str]:
        """Candidates that differ in shape alone are one cause."""
        return self.effect, self.where

    def is_possible(self, value: float) -> bool:
        """True for a physically possible sign and size."""
        return abs(value) <= self.largest and (self.sign == 0 or value * self.sign > 0)


@dataclass(frozen=True)
class Cause:
    """An effect at one place: its column as a function of the shape, and shapes to begin with."""

    candidate: Candidate
    column: Callable[[float | None], Volumes]
    shapes: tuple[float, ...] = ()
    offered: bool = True  # False: the record cannot hold it, but what another one taught counts

    def at(self, shape: float | None) -> Candidate:
        """The candidate with this shape."""
        return replace(self.candidate, shape=shape)

    def makes(self, candidate: Candidate) -> bool:
        """True for a candidate of this cause, whatever its shape."""
        return replace(candidate, shape=None) == self.candidate

    def finer(self, shape: float) -> tuple[float, ...]:
        """Shapes about the best of the bank, up to its neighbours."""
        bank = np.array(self.shapes)
        k = int(np.argmin(np.abs(bank - shape)))
        below = bank[k - 1] if k > 0 else bank[0] - 0.5 * (bank[1] - bank[0])
        above = bank[k + 1] if k + 1 < len(bank) else bank[-1] + 0.5 * (bank[-1] - bank[-2])
        return tuple(float(v) for v in np.linspace(below, above, 9)[1:-1])


@dataclass
class Columns:
    """Candidates and their series, in the order in which they were added."""

    n: int
    n_chambers: int
    candidates: list[Candidate] = field(default_factory=list)
    echo_of: dict[int, int] = field(default_factory=dict)  # column -> its echo's column
    _series: list[FloatArray] = field(default_factory=list)
    _source: list[list[int]] = field(default_factory=list)
    _sign: list[list[float]] = field(default_factory=list)

    def add(self, volumes: Volumes) -> int:
        """Another column; its number.  The same array twice is stored once."""
        source, sign = [0] * self.n_chambers, [0.0] * self.n_chambers
        for c, series in volumes.items():
            known = [k for k, s in enumerate(self._series) if s is series]
            source[c], sign[c] = (known[0] if known else len(self._series)), 1.0
            if not known:
                self._series.append(series)
        self._source.append(source)
        self._sign.append(sign)
        return len(self._source) - 1

    def volumes(self, column: int) -> Volumes:
        """The series of a column by chamber."""
        pairs = zip(self._source[column], self._sign[column], strict=True)
        return {c: self._series[k] for c, (k, sign) in enumerate(pairs) if sign}

    def offer(self, candidate: Candidate, volumes: Volumes) -> None:
        """Another candidate; candidates come before echoes."""
        self.candidates.append(candidate)
        self.add(volumes)

    def given(self) -> Given:
        """All columns as `evidence.collect` takes them."""
        series = np.stack(self._series, axis=1) if self._series else np.zeros((self.n - 1, 1))
        shape = (len(self._source), self.n_chambers)
        return Given(
            np.ascontiguousarray(series),
            np.array(self._source, np.int64).reshape(shape),
            np.array(self._sign, np.float64).reshape(shape),
        )


def causes(view: View) -> list[Cause]:
    """Every effect whose column is known once the map is: flows, storage, supply, drift."""
    if not view.has_pressures:
        return []
    makers = (
        _leaks,
        _seats,
        _valves_on_chambers,
        _storage,
        _lines,
        _supply,
        _drift,
        _sensors,
        _own,
    )
    return [cause for make in makers for cause in make(view)]


def ssqrt(z: FloatArray) -> FloatArray:
    """sign(z) sqrt |z|."""
    return np.asarray(np.sign(z) * np.sqrt(np.abs(z)))


def _fixed(candidate: Candidate, make: Callable[..., Volumes], *arguments: Any) -> Cause:
    """A cause without shape, its column being make(*arguments)."""
    return Cause(candidate, lambda _: make(*arguments))


LAMINAR, TURBULENT = "m3/s/Pa", "m3/s/sqrt(Pa)"


def _leaks(view: View) -> Iterator[Cause]:
    names = [c.name for c in view.model.chambers]
    if len(names) == 2:
        yield from _internal(view, f"{names[0]}-{names[1]}")
    for c, name in enumerate(names):
        drop = view.pressure(c) - view.tank
        for effect, unit, most, flow in (
            ("external_leakage_laminar", LAMINAR, 1e-9, drop),
            ("external_leakage_turbulent", TURBULENT, 1e-6, ssqrt(drop)),
        ):
            yield _fixed(
                Candidate(effect, name, "coefficient", unit, most),
                _out, view, c, flow,
            )  # fmt: skip


def _out(view: View, c: int, flow: FloatArray) -> Volumes:
    return {c: -view.over_intervals(flow)}


def _between(view: View, flow: FloatArray) -> Volumes:
    volume = view.over_intervals(flow)
    return {0: -volume, 1: volume}


def _internal(view: View, where: str) -> Iterator[Cause]:
    drop = view.pressure(0) - view.pressure(1)

    for effect, unit, most, flow in (
        ("internal_leakage_laminar", LAMINAR, 1e-9, drop),
        ("internal_leakage_turbulent", TURBULENT, 1e-6, ssqrt(drop)),
    ):
        yield _fixed(Candidate(effect, where, "coefficient", unit, most), _between, view, flow)
    low, high = float(view.x_m.min()), float(view.x_m.max())

    def worn(at: float | None) -> Volumes:
        near = np.clip(1.0 - np.abs(view.x_m - (at or 0.0)) / GROOVE_M, 0.0, 1.0)
        return _between(view, drop * near)

    yield Cause(
        Candidate("position_dependent_leakage", where, "coefficient", LAMINAR, 1e-9,
                  shape_name="position", shape_unit="m"),
        worn, tuple(float(v) for v in np.linspace(low, high, GROOVES)), high - low > GROOVE_M,
    )  # fmt: skip


def _seats(view: View) -> Iterator[Cause]:
    for edge in view.model.edges:
        signs = {c: edge.sign(chamber) for c, chamber in enumerate(view.model.chambers)}

        def make(edge: Edge = edge, signs: dict[int, int] = signs) -> Volumes:
            volume = view.over_intervals(ssqrt(view.signal(edge.source) - view.signal(edge.sink)))
            return {c: sign * volume for c, sign in signs.items() if sign}

        yield _fixed(
            Candidate("valve_seat_leakage", edge.name, "coefficient", TURBULENT, 1e-6), make
        )


def _valves_on_chambers(view: View) -> Iterator[Cause]:
    """Relief and make-up valves: opening pressures over the range that was seen."""
    for c in range(len(view.model.chambers)):
        p = view.pressure(c)
        low, high = (float(v) for v in np.quantile(p, [0.002, 0.998]))
        bank = tuple(float(v) for v in np.linspace(low, high, OPENINGS + 2)[1:-1])
        yield from _opening(view, "relief_valve", c, 1.0, bank, RELIEF_LAGS_S)
        yield from _opening(view, "makeup_valve", c, -1.0, bank, (0.0,))


def _opening(
    view: View, effect: str, c: int, sign: float, bank: tuple[float, ...], lags_s: tuple[float, ...]
) -> Iterator[Cause]:
    """A valve that lets out (sign +1) above its opening pressure, or in (-1) below it."""
    p, where = view.pressure(c), view.model.chambers[c].name
    for lag_s in lags_s:

        def make(at: float | None, lag_s: float = lag_s) -> Volumes:
            flow = -sign * np.maximum(0.0, sign * (p - (at or 0.0)))
            return {c: view.over_intervals(lagged(flow, view.step_s, lag_s))}

        candidate = Candidate(effect, where, "slope", LAMINAR, 1e-7, shape_name="opening_pressure",
                              shape_unit="Pa", lag_s=lag_s)  # fmt: skip
        yield Cause(candidate, make, bank)


def lagged(values: FloatArray, step_s: float, lag_s: float) -> FloatArray:
    """First-order lag, started at the first value; none for 0."""
    if lag_s <= 0.0:
        return values
    fade = float(np.exp(-step_s / lag_s))
    return np.asarray(lfilter([1 - fade], [1, -fade], values - values[0]) + values[0])


def stored(view: View, c: int, what: FloatArray) -> FloatArray:
    """- V d(what) over each interval (n - 1,), V in the middle of it."""
    v = view.volume(c)
    return np.asarray(-0.5 * (v[1:] + v[:-1]) * np.diff(what))


def air(pressure: FloatArray, kappa: float) -> FloatArray:
    """Volume of a gas as a share of that at one atmosphere, polytropic, taken negative."""
    ratio = ATMOSPHERE_PA / np.maximum(pressure, LEAST_PA)
    return np.asarray(-(ratio ** (1.0 / kappa)))


def _storage(view: View) -> Iterator[Cause]:
    """Air, dead volume, hoses: at each chamber, and at both alike."""
    for where, chambers in places(view).items():
        yield Cause(
            Candidate("entrained_air", where, "fraction_at_1_atm", "1", 0.5,
                      shape_name="polytropic_exponent", shape_unit="1"),
            partial(_stored_gas, view, chambers),
            (1.0, 1.2, 1.4),
        )  # fmt: skip
        yield _fixed(
            Candidate("extra_dead_volume", where, "volume", "m3", 1e-2),
            _dead_volume, view, chambers,
        )  # fmt: skip
        if len(chambers) == 1:
            lowest = min(float(view.pressure(c).min()) for c in chambers)
            yield Cause(
                Candidate("cavitation", where, "compliance", "1/Pa", 1e-3,
                          shape_name="saturation_pressure", shape_unit="Pa"),
                partial(_vapour, view, chambers),
                VAPOUR_PA, lowest < VAPOUR_PA[-1],
            )  # fmt: skip
            yield _fixed(
                Candidate("hose_compliance", where, "compliance", "m3/Pa", 1e-11),
                _hose, view, chambers,
            )  # fmt: skip


def _stored_gas(view: View, chambers: tuple[int, ...], kappa: float | None) -> Volumes:
    return {c: stored(view, c, air(view.pressure(c), kappa or 1.0)) for c in chambers}


def _dead_volume(view: View, chambers: tuple[int, ...]) -> Volumes:
    return {c: -view.compliance[c] * np.diff(view.pressure(c)) for c in chambers}


def _hose(view: View, chambers: tuple[int, ...]) -> Volumes:
    return {c: -np.diff(view.pressure(c)) for c in chambers}


def _vapour(view: View, chambers: tuple[int, ...], saturation: float | None) -> Volumes:
    below = {c: np.maximum(0.0, (saturation or 0.0) - view.pressure(c)) for c in chambers}
    return {c: stored(view, c, -below[c]) for c in chambers}


def places(view: View) -> dict[str, tuple[int, ...]]:
    """The chambers by name, and both."""
    found = {chamber.name: (c,) for c, chamber in enumerate(view.model.chambers)}
    return found | ({"both": (0, 1)} if len(found) == 2 else {})


def _lines(view: View) -> Iterator[Cause]:
    """Inertance of a line between valve and chamber, seen by a sensor at either end of it."""
    for c, chamber in enumerate(view.model.chambers):
        for end in ("valve", "cylinder"):
            parameter = f"inertance_sensor_at_{end}"
            yield _fixed(
                Candidate("line_dynamics", chamber.name, parameter, "Pa s2/m3", 1e11),
                _line, view, c, end,
            )  # fmt: skip


def _line(view: View, c: int, end: str) -> Volumes:
    rate = view.smooth(view.chamber_flow(c), 1)
    if end == "cylinder":
        return {c: rate * slope_to(view, c) * view.dt_s}
    bend = np.diff(rate, prepend=rate[:1])
    return {c: view.compliance[c] * view.volume(c)[:-1] * bend}


def slope_to(view: View, c: int) -> FloatArray:
    """Change of the flow into chamber c per Pa of its own pressure (n - 1,), negative."""
    chamber = view.model.chambers[c]
    toward = [
        int(edge.source == chamber.pressure) - int(edge.sink == chamber.pressure)
        for edge in view.model.edges
    ]
    return view.into_chamber(c, [k * view.slope_dp(i) for i, k in enumerate(toward)])


def _supply(view: View) -> Iterator[Cause]:
    """A supply that gives way to what is drawn, in two forms.

    By a resistance behind a lag, as a pump's characteristic and its line are; or by the volume that
    is drawn beyond a pump's flow, times the stiffness of the line, recovering to the nominal value.
    """
    if not view.supply_name:
        return
    n_e = len(view.model.edges)
    fed = [i for i, e in enumerate(view.model.edges) if e.source == view.supply_name]
    demand = np.sum([_drawn(view, i) for i in fed], axis=0)
    slopes = [view.slope_dp(i) if i in fed else np.zeros(view.n - 1) for i in range(n_e)]
    drawn = demand[demand > 0]
    unmeasured = len(drawn) > 0 and not view.supply_is_measured

    def lowered(sag: FloatArray) -> Volumes:
        return {
            c: -view.into_chamber(c, slopes) * sag * view.dt_s
            for c in range(len(view.model.chambers))
        }

    bank = tuple(float(v) for v in np.quantile(drawn, PUMP_FLOWS)) if len(drawn) else ()

    def make(pump: float | None) -> Volumes:
        missing = np.empty(len(demand))
        draw_down(demand - (pump or 0.0), view.dt_s, missing)
        return lowered(missing)

    yield Cause(
        Candidate("supply_sag", view.supply_name, "resistance", "Pa s/m3", 1e12,
                  shape_name="time_constant", shape_unit="s"),
        lambda tau: lowered(lagged(demand, view.step_s, tau or 0.0)), SAG_TIMES_S, unmeasured,
    )  # fmt: skip
    yield Cause(
        Candidate("supply_sag", view.supply_name, "stiffness", "Pa/m3", 1e12,
                  shape_name="pump_flow", shape_unit="m3/s"),
        make, bank, unmeasured,
    )  # fmt: skip


def _drawn(view: View, i: int) -> FloatArray:
    """What edge i draws while it is open, by the measured motion (n - 1,), m3/s."""
    edge = view.model.edges[i]
    c = next(k for k, chamber in enumerate(view.model.chambers) if edge.sign(chamber) > 0)
    chamber = view.model.chambers[c]
    swept = chamber.sign * chamber.area_m2 * view.smooth(view.x_m, 1)[:-1]
    return np.where(view.flow(i) > 0.0, np.maximum(swept, 0.0), 0.0)


@kernel
def draw_down(excess: FloatArray, dt_s: FloatArray, missing: FloatArray) -> None:
    """Volume missing from a line that is drawn from by `excess` m3/s, never below zero, (n,)."""
    level = 0.0
    for k in range(len(excess)):
        after = max(0.0, level + excess[k] * dt_s[k])
        missing[k] = 0.5 * (level + after)
        level = after


def _drift(view: View) -> Iterator[Cause]:
    """All valves give more, or less, as time goes on: relative change per second."""

    def make() -> Volumes:
        t = view.t_s[1:]  # of the whole trace, or the held-out part would begin anew
        n_c = len(view.model.chambers)
        return {c: view.chamber_flow(c) * t * view.dt_s for c in range(n_c)}

    yield _fixed(
        Candidate("valve_gain_drift", "all valves", "relative_change", "1", 1.0, sign=0), make
    )


def _sensors(view: View) -> Iterator[Cause]:
    """Slow pressure sensors, and a position that comes late."""
    for c, chamber in enumerate(view.model.chambers):
        yield _fixed(
            Candidate("pressure_sensor_lag", chamber.name, "time_constant", "s", 0.2),
            _slow_pressure, view, c,
        )  # fmt: skip
    yield _fixed(
        Candidate("position_sensor_delay", view.model.position, "delay", "s", 0.2),
        _late_position, view,
    )  # fmt: skip


def _slow_pressure(view: View, c: int) -> Volumes:
    """The true pressure is ahead by tau dP/dt, in the map and in what is stored."""
    rate = view.smooth(view.pressure(c), 1)
    through = 0.5 * (rate[1:] + rate[:-1]) * slope_to(view, c) * view.dt_s
    return {c: through + view.compliance[c] * stored(view, c, rate)}


def _late_position(view: View) -> Volumes:
    """A delay takes from the position what was gained within it: the flow before the delay."""
    late = {}
    for c in range(len(view.model.chambers)):
        rate = view.smooth(view.pressure(c), 1)[:-1]
        swept = view.chamber_flow(c) - view.compliance[c] * view.volume(c)[:-1] * rate
        late[c] = -np.diff(swept, prepend=swept[:1])
    return late


def _own(view: View) -> Iterator[Cause]:
    """Effects that the user has defined: one cause per combination of their shape parameters."""
    names = [chamber.name for chamber in view.model.chambers]
    seen = effects.View(view.model, view.t_s, view.chunk[:, 2:])
    for effect in view.model.own_effects:
        signs = {names.index(name): sign for name, sign in effect.signs}
        for shape in effect.bank():
            parameter = ", ".join(["coefficient", *(f"{k} = {v:g}" for k, v in shape.items())])
            candidate = Candidate(
                effect.name, "own effect", parameter, effect.unit, effect.largest, effect.sign
            )
            yield _fixed(candidate, _own_volumes, effect, seen, shape, signs)


def _own_volumes(
    effect: effects.UserEffect, seen: effects.View, shape: dict[str, float], signs: dict[int, int]
) -> Volumes:
    volume = effect.volume(seen, shape)
    return {c: sign * volume for c, sign in signs.items()}


def add_echoes(view: View, columns: Columns, first: int) -> None:
    """Echoes of theta_beta and of every storage candidate: the same columns of noise alone.

    first: number of given columns before the candidates.
    """
    rng = np.random.default_rng(SEED)
    n_c, noise = columns.n_chambers, {}
    for c, chamber in enumerate(view.model.chambers):
        sd = np.sqrt(variance(view.model, chamber.pressure) * view.model.pressure_share)
        noise[c] = sd * rng.standard_normal(view.n)
        echo = columns.add({c: view.compliance[c] * stored(view, c, noise[c])})
        columns.echo_of[1 + c] = 1 + n_c + echo
    by_place = places(view)
    for k, candidate in enumerate(columns.candidates):
        make = _NOISY.get(candidate.effect)
        if make is not None:
            volumes = {
                c: make(view, c, noise[c], candidate.shape) for c in by_place[candidate.where]
            }
            columns.echo_of[1 + n_c + first + k] = 1 + n_c + columns.add(volumes)


def _air_echo(view: View, c: int, noise: FloatArray, shape: float | None) -> FloatArray:
    p, kappa = view.pressure(c), shape or 1.0
    return stored(view, c, air(p + noise, kappa) - air(p, kappa))


_NOISY: dict[str, Callable[[View, int, FloatArray, float | None], FloatArray]] = {
    "entrained_air": _air_echo,
    "extra_dead_volume": lambda view, c, noise, _: -view.compliance[c] * np.diff(noise),
    "hose_compliance": lambda view, c, noise, _: -np.diff(noise),
}
