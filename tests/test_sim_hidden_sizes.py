"""The stated strength is the coefficient that the plain column has over a record, within 10 %.

The simulated forms differ from the columns of the effect catalogue; sizes must not.
"""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import lfilter

from rtid.plain import FloatArray
from rtid.sim import extra_flows
from rtid.sim.extra_physics import parts_of
from rtid.sim.hidden import HIDDEN, hide
from rtid.sim.run import EXACT, Run, simulate
from rtid.sim.simulated_plant import SimulatedPlant

Pair = tuple[FloatArray, FloatArray]  # what the simulator did, the plain column for a coefficient 1


def pressures(run: Run) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Of A, B, supply and tank."""
    s = run.truth.signals
    return s[:, 1], s[:, 2], s[:, 3], s[:, 4]


def root(drop: FloatArray) -> FloatArray:
    return np.asarray(np.sign(drop) * np.sqrt(np.abs(drop)))


def internal(run: Run, law: Callable[[FloatArray], FloatArray]) -> Pair:
    a, b, _, _ = pressures(run)
    return run.truth.extra_m3s[:, 1], law(a - b)


def external(run: Run, law: Callable[[FloatArray], FloatArray]) -> Pair:
    a, _, _, tank = pressures(run)
    return -run.truth.extra_m3s[:, 0], law(a - tank)


def seat(run: Run) -> Pair:
    a, _, supply, _ = pressures(run)
    shut = run.truth.opening_v[:, 0] < 1.0
    return run.truth.flow("pa")[shut], root(supply - a)[shut]


def relief(run: Run) -> Pair:
    opening = run.plant.extra.relief_open_pa[0]
    return -run.truth.extra_m3s[:, 0], np.maximum(0.0, run.truth.signals[:, 1] - opening)


def makeup(run: Run) -> Pair:
    opening = run.plant.extra.makeup_open_pa[0]
    return run.truth.extra_m3s[:, 0], np.maximum(0.0, opening - run.truth.signals[:, 1])


def air(run: Run) -> Pair:
    """Against isothermal air, both chambers together; volumes are alike and left out."""
    c, e = run.plant.constants, parts_of(run.plant.extra)
    assert e is not None
    p = np.concatenate(pressures(run)[:2])
    rate = np.concatenate([np.gradient(p, 1e-3) for p in pressures(run)[:2]])
    soft = [extra_flows.compressibility(c, e, e.a, at) - 1 / c.beta_pa for at in p]
    return np.array(soft) * rate, 101325 / p**2 * rate


def hose(run: Run) -> Pair:
    """A chamber's pressure rate, weighed with the wall's softness."""
    p = np.concatenate(pressures(run)[:2])
    rate = np.concatenate([np.gradient(p, 1e-3) for p in pressures(run)[:2]])
    return 5e-13 * rate / (1 + (p - 4e6) / 8e6), rate


def sag(run: Run) -> Pair:
    drawn, fade = run.truth.flow("pa") + run.truth.flow("pb"), np.exp(-1e-3 / 0.4)
    smooth = lfilter([1 - fade], [1, -fade], drawn)
    return run.samples.column("p_supply") - run.truth.signals[:, 3], smooth


def drift(run: Run) -> Pair:
    """A change linear in time beside the mean flow, which a free map takes."""
    a, _, supply, _ = pressures(run)
    plain = run.plant.flow("pa", run.truth.opening_v[:, 0], supply - a)
    t = np.linspace(0, 1, len(plain))
    mean = (plain @ (plain * t)) / (plain @ plain)
    return run.truth.flow("pa") - plain, plain * (t - mean)


def groove(run: Run) -> Pair:
    """The middle one of three triangles over the stroke that was used."""
    a, b, _, _ = pressures(run)
    x = run.truth.signals[:, 5]
    inside = (x - x.min()) / np.ptp(x)
    bells = [np.clip(1 - np.abs(3 * inside - k - 0.5), 0, 1) * (a - b) for k in range(3)]
    others = np.stack([bells[0], bells[2]], axis=1)
    alone = bells[1] - others @ np.linalg.lstsq(others, bells[1], rcond=None)[0]
    return run.truth.extra_m3s[:, 1], alone


def inertance(run: Run) -> Pair:
    """Pressure along the hose of A against the acceleration of the flow in it."""
    c, s = run.plant.constants, run.truth.signals
    half = 0.5 * run.plant.extra.line_m[0] * extra_flows.HOSE_AREA_M2
    volume = c.v0_a_m3 + c.area_a_m2 * s[:, 5] + half
    flow = volume / c.beta_pa * np.gradient(s[:, 1], 1e-3) + c.area_a_m2 * s[:, 6]
    return run.truth.ports_pa[:, 0] - s[:, 1], np.gradient(flow, 1e-3)


def line(drop: FloatArray) -> FloatArray:
    return drop


SIZES: dict[str, Callable[[Run], Pair]] = {
    "internal_leakage_laminar": lambda run: internal(run, line),
    "internal_leakage_turbulent": lambda run: internal(run, root),
    "external_leakage_laminar": lambda run: external(run, line),
    "external_leakage_turbulent": lambda run: external(run, root),
    "valve_seat_leakage": seat,
    "relief_valve": relief,
    "makeup_valve": makeup,
    "entrained_air": air,
    "hose_compliance": hose,
    "supply_sag": sag,
    "valve_gain_drift": drift,
    "position_dependent_leakage": groove,
    "line_dynamics": inertance,
}


@pytest.mark.parametrize("motion", [pytest.param("sweep", marks=pytest.mark.long), "rich"])
@pytest.mark.parametrize("name", SIZES)
def test_stated_size_is_the_effective_one(name: str, motion: str) -> None:
    strength = HIDDEN[name].strengths[1]
    run = simulate(hide(SimulatedPlant(), name, strength), motion, 1, 40.0, EXACT)
    done, column = SIZES[name](run)
    found = (done @ column) / (column @ column)
    assert found == pytest.approx(strength, rel=0.105)
