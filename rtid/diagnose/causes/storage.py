"""What a chamber stores beside its oil: gas, dead volume, hoses; and the echoes of the noise."""

from __future__ import annotations

from collections.abc import Iterator
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
    return {c: -view.compliance[c] * np.diff(view.pressure(c)) for c in chambers}


def _hose(view: View, chambers: tuple[int, ...]) -> Volumes:
    return {c: -np.diff(view.pressure(c)) for c in chambers}


def _vapour(view: View, chambers: tuple[int, ...], shape: Shape) -> Volumes:
    below = {c: np.maximum(0.0, shape[0] - view.pressure(c)) for c in chambers}
    return {c: stored(view, c, -below[c]) for c in chambers}


def add_echoes(view: View, columns: Columns, first: int) -> None:
    """Echoes of theta_beta and of every storage candidate: the same columns of noise alone.

    first: number of given columns before the candidates.
    """
    rng = np.random.default_rng(SEED)
    n_c, noise = len(view.model.chambers), {}
    for c, chamber in enumerate(view.model.chambers):
        sd = np.sqrt(variance(view.model, chamber.pressure) * view.model.pressure_share)
        noise[c] = sd * rng.standard_normal(view.n)
        echo = columns.add({c: view.compliance[c] * stored(view, c, noise[c])})
        columns.echo_of[1 + c] = 1 + n_c + echo
    for k, candidate in enumerate(columns.candidates):
        soft = {c: softness(view, c, candidate) for c in noise}
        volumes = {c: -np.diff(soft[c] * noise[c]) for c in noise if soft[c].any()}
        if volumes:
            columns.echo_of[1 + n_c + first + k] = 1 + n_c + columns.add(volumes)


def softness(view: View, c: int, candidate: Candidate) -> FloatArray:
    """What one unit of a storage effect takes up in chamber c per Pa (n,), m3/Pa; 0 for others."""
    p, still = view.pressure(c), np.zeros(view.n)
    if c not in places(view).get(candidate.where, ()):
        return still
    match candidate.effect:
        case "entrained_air":
            kappa = candidate.shape[0]
            rise = air(p + SMALL_PA, kappa) - air(p - SMALL_PA, kappa)
            return np.asarray(view.volume(c) * rise / (2.0 * SMALL_PA))
        case "extra_dead_volume":
            return still + view.compliance[c]
        case "hose_compliance":
            return still + 1.0
        case "cavitation":
            return view.volume(c) * (p < candidate.shape[0])
    return still
