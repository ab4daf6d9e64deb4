"""Columns of causes with more than one shape: what they are made of, and what the noise does."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rtid.diagnose.fit import first_map, prepare
from rtid.effects.column import Cause
from rtid.effects.laws import causes
from rtid.effects.laws.storage import softness
from rtid.effects.record_view import RecordView
from rtid.plain import FloatArray
from tests.diagnose.records import record

STORAGE = ("entrained_air", "extra_dead_volume", "hose_compliance", "cavitation")
SMALL_PA = 200.0


@cache
def view() -> RecordView:
    model, chunk, _ = record()
    weights = prepare(model, chunk)
    return RecordView.of(model, chunk, weights, first_map(model, chunk, weights))


def cause(effect: str, where: str = "a") -> Cause:
    return next(
        c
        for c in causes(view())
        if c.candidate.effect == effect and c.candidate.where in (where, "both")
    )


def flow(shape: tuple[float, ...], effect: str = "relief_valve") -> FloatArray:
    """Mean flow over each interval for a slope of 1 (n - 1,)."""
    return cause(effect).column(shape)[0] / view().dt_s


def opening() -> float:
    return float(np.quantile(view().pressure(0), 0.6))


@pytest.mark.parametrize("volume_m3", [1.4e-5, 5e-5])
def test_the_derivative_of_a_small_line_is_taken_where_a_line_can_be(volume_m3: float) -> None:
    """From a negative volume on it exploded, and with it the whole diagnosis of a machine."""
    line = cause("line_dynamics", "both")
    radps, resistance, step_m3 = 827.0, 5e8, 1e-7
    slope = line.slope((radps, volume_m3, resistance), 1)[0]
    up, down = (line.column((radps, volume_m3 + s, resistance))[0] for s in (step_m3, -step_m3))
    exact = (up - down) / (2.0 * step_m3)
    assert np.sqrt(np.mean((slope - exact) ** 2)) < 0.5 * np.sqrt(np.mean(exact**2))


def test_a_relief_valve_lets_out_above_its_opening_pressure() -> None:
    p = view().pressure(0)
    out = np.maximum(0.0, p - opening())
    assert flow((opening(), 0.0, 0.0)) == pytest.approx(-0.5 * (out[1:] + out[:-1]))
    into = np.maximum(0.0, opening() - p)
    fed = flow((opening(), 0.0, 0.0), "makeup_valve")
    assert fed == pytest.approx(0.5 * (into[1:] + into[:-1]))


def test_a_poppet_of_its_own_time_constant_follows_the_flow() -> None:
    """tau dq/dt = q_static - q, against a solver."""
    tau_s, n = 0.04, 3000
    static = -np.maximum(0.0, view().pressure(0) - opening())
    t_s = view().t_s[:n] - view().t_s[0]
    done = solve_ivp(
        lambda t, q: (np.interp(t, t_s, static[:n]) - q) / tau_s,
        (0, t_s[-1]), static[:1], t_eval=t_s, max_step=1e-3,
    )  # fmt: skip
    expected = 0.5 * (done.y[0, 1:] + done.y[0, :-1])
    found = flow((opening(), tau_s, 0.0))[: n - 1]
    assert np.abs(found - expected).max() < 0.02 * np.abs(static[:n]).max()


def test_hysteresis_opens_late_and_closes_late() -> None:
    """Half its width: above the opening pressure where the pressure rises, below where it falls."""
    width, p = 0.2e6, view().smooth(view().pressure(0))
    is_open = flow((opening(), 0.0, width)) < 0.0
    low, high = np.minimum(p[1:], p[:-1]), np.maximum(p[1:], p[:-1])
    assert is_open[high > opening() + 0.5 * width].all()
    assert not is_open[high <= opening() - 0.5 * width].any()
    between = (low > opening() - 0.5 * width) & (high < opening() + 0.5 * width)
    assert is_open[between].any() and not is_open[between].all()


@pytest.mark.parametrize("effect", STORAGE)
def test_softness_is_the_derivative_of_the_column_by_the_pressure(effect: str) -> None:
    """A single sample's pressure taken up: what the column stores more, per Pa."""
    own = next((c for c in causes(view()) if c.candidate.effect == effect), None)
    assert own is not None
    middle = own.shapes[len(own.shapes) // 2]  # behind a port, a single sample is not seen
    names = zip(own.candidate.shape_names, middle, strict=True)
    shape = tuple(0.0 if name == "port_lag" else value for name, value in names)
    soft = softness(view(), own.at(shape))
    for k in (500, 9000, 21000):
        for c, taken in soft.items():
            changes = [stored_at(own, shape, k, c, s * SMALL_PA) for s in (1.0, -1.0)]
            assert (changes[0] - changes[1]) / (2 * SMALL_PA) == pytest.approx(-taken[k], rel=0.02)


def stored_at(its_own: Cause, shape: tuple[float, ...], k: int, c: int, more_pa: float) -> float:
    """What the interval before sample k stores when the pressure of sample k is a little higher."""
    model, chunk, _ = record()
    changed = chunk[k - 2 : k + 3].copy()
    changed[2, 2 + model.column(model.chambers[c].pressure)] += more_pa
    other = RecordView.without_map(model, changed, view().compliance)
    like = next(x for x in causes(other) if x.candidate == its_own.candidate)
    return float(like.column(shape)[c][1])
