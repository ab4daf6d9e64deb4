"""What a chamber stores beside its oil: gas, dead volume, hoses; and the echoes of the noise."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial

import numpy as np

from rtid.diagnose.candidates import (
    Candidate,
    Cause,
    Columns,
    Shape,
    Volumes,
    fixed,
    places,
)
from rtid.diagnose.causes.common import stored
from rtid.diagnose.view import View
from rtid.estimator.state import variance
from rtid.model import FloatArray

ATMOSPHERE_PA = 101325.0
SMALL_PA = 1e3  # for derivatives
LEAST_PA = 5e4  # below, gas and vapour follow other laws: cavitation
VAPOUR_PA = (2e4, 5e4, 1e5, 1.5e5, 2e5)  # below which gas may come out of the oil
SEED = 20051005  # of the noise that stands for the sensors' own


def air(pressure: FloatArray, kappa: float) -> FloatArray:
    """Volume of a gas as a share of that at one atmosphere, polytropic, taken negative."""
    ratio = ATMOSPHERE_PA / np.maximum(pressure, LEAST_PA)
    return np.asarray(-(ratio ** (1.0 / kappa)))


def storage(view: View) -> Iterator[Cause]:
    """Air, dead volume, hoses: at each chamber, and at both alike."""
    for where, chambers in places(view).items():
        yield Cause(
            Candidate("entrained_air", where, "fraction_at_1_atm", "1", 0.5,
                      shape_names=("polytropic_exponent",), shape_units=("1",)),
            partial(_stored_gas, view, chambers),
            ((1.0, 1.2, 1.4),),
        )  # fmt: skip
        yield fixed(
            Candidate("extra_dead_volume", where, "volume", "m3", 1e-2),
            _dead_volume, view, chambers,
        )  # fmt: skip
        if len(chambers) == 1:
            lowest = min(float(view.pressure(c).min()) for c in chambers)
            yield Cause(
                Candidate("cavitation", where, "compliance", "1/Pa", 1e-3,
                          shape_names=("saturation_pressure",), shape_units=("Pa",)),
                partial(_vapour, view, chambers),
                (VAPOUR_PA,), offered=lowest < VAPOUR_PA[-1],
            )  # fmt: skip
            yield fixed(
                Candidate("hose_compliance", where, "compliance", "m3/Pa", 1e-11),
                _hose, view, chambers,
            )  # fmt: skip


def _stored_gas(view: View, chambers: tuple[int, ...], shape: Shape) -> Volumes:
    return {c: stored(view, c, air(view.pressure(c), shape[0])) for c in chambers}


def _dead_volume(view: View, chambers: tuple[int, ...]) -> Volumes:
    compliance = _compliance(view, chambers)
    return {c: -compliance * np.diff(view.pressure(c)) for c in chambers}


def _hose(view: View, chambers: tuple[int, ...]) -> Volumes:
    return {c: -np.diff(view.pressure(c)) for c in chambers}


def _vapour(view: View, chambers: tuple[int, ...], shape: Shape) -> Volumes:
    below = {c: np.maximum(0.0, shape[0] - view.pressure(c)) for c in chambers}
    return {c: stored(view, c, -below[c]) for c in chambers}


def add_echoes(
    view: View, columns: Columns, first: int, slopes: list[tuple[Cause, Shape, int]]
) -> None:
    """Echoes of theta_beta and of every storage column: the same columns of noise alone.

    first: number of given columns before the slopes and the candidates; slopes: cause, shape and
    parameter of each derivative column.
    """
    rng = np.random.default_rng(SEED)
    n_c, noise = len(view.model.chambers), {}
    for c, chamber in enumerate(view.model.chambers):
        sd = np.sqrt(variance(view.model, chamber.pressure) * view.model.pressure_share)
        noise[c] = sd * rng.standard_normal(view.n)
        echo = columns.add({c: view.compliance[c] * stored(view, c, noise[c])})
        columns.echo_of[1 + c] = 1 + n_c + echo

    def soft(cause: Cause, shape: Shape) -> Volumes:
        return softness(view, cause.at(shape))

    taken_up = [cause.slope_of(partial(soft, cause), shape, k) for cause, shape, k in slopes]
    taken_up += [softness(view, candidate) for candidate in columns.candidates]
    for k, by_chamber in enumerate(taken_up):
        if by_chamber:
            echo = columns.add({c: -np.diff(m * noise[c]) for c, m in by_chamber.items()})
            columns.echo_of[1 + n_c + first + k] = 1 + n_c + echo


def softness(view: View, candidate: Candidate) -> Volumes:
    """What one unit of a storage effect takes up per Pa, by chamber (n,), m3/Pa; {} for others."""
    chambers = places(view).get(candidate.where, ())
    match candidate.effect:
        case "entrained_air":
            return {c: _gas_softness(view, c, candidate.shape[0]) for c in chambers}
        case "extra_dead_volume":
            return {c: np.full(view.n, _compliance(view, chambers)) for c in chambers}
        case "hose_compliance":
            return {c: np.ones(view.n) for c in chambers}
        case "cavitation":
            below = {c: view.pressure(c) < candidate.shape[0] for c in chambers}
            return {c: view.volume(c) * below[c] for c in chambers}
    return {}


def _gas_softness(view: View, c: int, kappa: float) -> FloatArray:
    p = view.pressure(c)
    rise = air(p + SMALL_PA, kappa) - air(p - SMALL_PA, kappa)
    return np.asarray(view.volume(c) * rise / (2.0 * SMALL_PA))


def _compliance(view: View, chambers: tuple[int, ...]) -> float:
    """One oil: the compliance that the chambers have between them, 1/Pa."""
    return float(np.mean(view.compliance[list(chambers)]))


def total_softness(view: View, sizes: Iterable[tuple[Candidate, float]]) -> FloatArray:
    """What effects of these sizes take up per Pa (n, chambers), m3/Pa."""
    total = np.zeros((view.n, len(view.model.chambers)))
    for candidate, size in sizes:
        for c, one in softness(view, candidate).items():
            total[:, c] += size * one
    return total
