"""A finite pump: its equation, its limits, and what counts as drawn from it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from rtid.diagnose import exact
from rtid.diagnose.experiment import varied_supply
from rtid.diagnose.fit import Fit, fit, one_pass, prepare
from rtid.diagnose.fitted_sizes import parameters
from rtid.diagnose.regression import Score
from rtid.diagnose.report import LOOKS_LIKE, MISLED, Unseen
from rtid.diagnose.revision import Revision
from rtid.diagnose.search import Search
from rtid.diagnose.summary import _told
from rtid.diagnose.trials import scored
from rtid.diagnose.unseen import _limit
from rtid.diagnose.verdict import UNKNOWN
from rtid.effects.column import Candidate
from rtid.effects.laws import pump
from rtid.effects.laws.pump import PUMP, demand, drawn_down, usual_demand
from rtid.effects.record_view import RecordView
from rtid.model import MODE, Machine, Signal
from rtid.plain import FloatArray
from rtid.tell.diagnosed import folded
from tests.diagnose.records import record

DT = 1e-3
R, Q_P, S = 2e9, 4e-4, 2e10  # 0.8 MPa of droop at the limit, a lag of 0.1 s


def moves(seed: int, n: int = 1200) -> FloatArray:
    """A demand that stands still, crosses the limit of the pump and falls back (n,)."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(0.0, 3.0 * Q_P, n // 60) * rng.integers(0, 2, n // 60), 60)


@pytest.mark.parametrize("seed", range(4))
def test_it_solves_the_pump_s_equation(seed: int) -> None:
    """Each held demand against a solver, also across the limit of the pump in either direction."""

    def rate(_: float, d: FloatArray, q: float) -> list[float]:
        return [S * (q - min(Q_P, max(0.0, d[0]) / R))]

    drawn, exact = moves(seed), [0.0]
    for q in drawn[:-1]:
        done = solve_ivp(
            rate, (0, DT), [exact[-1]], max_step=DT / 8, rtol=1e-9, atol=1e-3, args=(q,)
        )
        exact.append(max(0.0, done.y[0, -1]))
    assert max(exact) > 1.2 * R * Q_P > min(exact) == 0.0
    assert np.abs(drawn_down(drawn, DT, (R, Q_P, S)) - exact).max() < 1e-5 * R * Q_P


def test_a_steady_demand_droops_by_the_resistance() -> None:
    drawn = np.full(3000, 0.5 * Q_P)
    assert drawn_down(drawn, DT, (R, Q_P, S))[-1] == pytest.approx(0.5 * R * Q_P, rel=1e-9)


def test_beyond_its_limit_the_accumulator_gives_the_rest() -> None:
    """The supply falls in a straight line of slope s (Q - Q_p)."""
    d = drawn_down(np.full(3000, 1.5 * Q_P), DT, (R, Q_P, S))
    assert np.diff(d)[-500:] == pytest.approx(0.5 * Q_P * S * DT, rel=1e-9)


@given(st.integers(0, 1000), st.floats(1e6, 1e12), st.floats(1e-6, 1e-1), st.floats(1e7, 1e14))
def test_it_stays_finite_and_never_rises_above_the_set_pressure(
    seed: int, r: float, q_p: float, s: float
) -> None:
    drawn = moves(seed, 120)
    d = drawn_down(drawn, DT, (r, q_p, s))
    assert np.isfinite(d).all() and d.min() >= 0.0
    assert d.max() <= r * drawn.max() + s * DT * drawn.sum()
    plain = [0.0]
    for q in drawn[:-1]:
        plain.append(max(0.0, pump._step.py_func(plain[-1], q, DT, r, q_p, s)))
    assert d == pytest.approx(plain, rel=1e-9, abs=1e-6)


def with_mode(model: Machine, chunk: FloatArray, mode: FloatArray) -> tuple[Machine, FloatArray]:
    """The same machine whose supply edges may open in mode 1 alone."""
    edges = tuple(
        replace(e, modes=(1,)) if e.source == "p_supply" else replace(e, modes=(0, 1))
        for e in model.edges
    )
    signals = (*model.signals, Signal("mode", MODE))
    model = replace(model, edges=edges, signals=signals, mode="mode")
    return model, np.column_stack([chunk, mode])


def test_edges_that_the_mode_keeps_shut_draw_nothing() -> None:
    model, chunk, _ = record()
    free = demand(RecordView.without_map(model, chunk))
    mode = (np.arange(len(chunk)) % 400 < 200).astype(float)
    held = demand(RecordView.without_map(*with_mode(model, chunk, mode)))
    assert free.max() > 0
    assert held == pytest.approx(np.where(mode == 1, free, 0.0))


def test_a_pump_compresses_the_oil_of_what_it_feeds() -> None:
    """The stiffness of a foreign accumulator was 1.6 % off without it, at 32 deviations."""
    model, chunk, _ = record()
    still, by_name = chunk[:2000].copy(), {s.name: k for k, s in enumerate(model.signals, 2)}
    fed = model.chambers[0]
    still[:, by_name[model.position]] = 0.2
    still[:, by_name[fed.pressure]] = 3e6 + 2e8 * (still[:, 0] - still[0, 0])
    for edge in model.edges:
        still[:, by_name[edge.command]] = 5.0 * next(
            e.direction for e in model.edges if e.source == "p_supply" and e.sign(fed) > 0
        )
    oil = RecordView.without_map(model, still, np.full(2, 1e-9))
    taken = float(fed.volume(np.array([0.2]))[0]) * 1e-9 * 2e8
    assert demand(oil)[:-1] == pytest.approx(np.full(1999, taken), rel=1e-3)
    assert not demand(RecordView.without_map(model, still)).any(), "of nobody's compliance none"


def test_a_record_with_a_sag_is_varied_as_it_was_recorded() -> None:
    """Each fit applies the sag of its revision: the record of an experiment must not have it."""
    model, chunk, _ = record()
    weights = prepare(model, chunk)
    plain = one_pass(model, chunk, weights, Revision(), None, False, thorough=False)
    sagging = Revision(timings=((PUMP, (1e9, 1.0, 1e11)),))
    sagged = one_pass(model, chunk, weights, sagging, None, False, thorough=False)
    supply = 2 + model.column("p_supply")
    assert sagged.sent[:, supply].min() < plain.sent[:, supply].min() - 1e4
    varied = [varied_supply(f) for f in (plain, sagged)]
    assert varied[0] is not None and varied[1] is not None
    assert varied[1][:, supply] == pytest.approx(varied[0][:, supply])


@cache
def sagging() -> tuple[Fit, tuple[float, float, float]]:
    """A machine whose pump gives way at its limit, by exactly its law, fitted without one.

    With the pump: what the declared supply is too high by is D.
    """
    model, chunk, _ = record(seed=5)
    drawn = usual_demand(RecordView.without_map(model, chunk))
    psi = 1.5e9, float(np.quantile(drawn[drawn > 0], 0.8)), 3e10
    supply, dt = 2 + model.column("p_supply"), float(np.median(np.diff(chunk[:, 0])))
    declared = chunk.copy()
    declared[:, supply] = np.median(chunk[:, supply]) + drawn_down(drawn, dt, psi)
    return fit(model, declared, prepare(model, declared), Revision()), psi


@pytest.mark.long
def test_a_pump_is_looked_for_where_its_limit_is_seen() -> None:
    """About a droop alone the search began in a valley that explains nothing of it."""
    present, truth = sagging()
    beside = Search(present.declared, present.chunk).beside(present)
    *_, at_limit = exact._pumps(present)
    best = beside.gain(PUMP, beside.polished(PUMP, at_limit))
    assert best > 0.7 * beside.gain(PUMP, truth) > 0.0


def told_beside_unknown(present: Any, candidate: Candidate, score: Score) -> Unseen:
    result: Any = SimpleNamespace(last=present, verdict=UNKNOWN, reach={}, negligible={})
    return _limit(result, candidate, score)


def test_no_limit_is_told_beside_much_that_is_unknown() -> None:
    """Of a sag, a thousandth; of two relief valves a fiftieth: each makes up for another."""
    present, _ = sagging()
    scores = scored(present)
    assert present.rho > exact.LARGE and {PUMP.effect, "relief_valve"} <= {
        c.effect for c, _ in scores
    }
    for candidate, score in scores:
        unseen = told_beside_unknown(present, candidate, score)
        assert (unseen.detection_limit, unseen.named_from) == (None, None)
        assert unseen.reason == MISLED


def test_beside_a_little_that_is_unknown_no_less_is_excluded_than_the_record_shows() -> None:
    present, _ = sagging()
    little: Any = SimpleNamespace(
        **{n: getattr(present, n) for n in ("view", "declared", "weights")}
    )
    little.rho, little.most_rho, little.lag_tolerance_s = 1.21, 1.1, 0.0
    little.revision = present.revision
    relief, score = next((c, s) for c, s in scored(present) if c.effect == "relief_valve")
    for value, limit in ((30.0, 32.156), (3.0, 4.4)):  # Z95 and LIMIT_SD times 1.1 on top, or alone
        shown = replace(score, value=value * score.sd)
        unseen = told_beside_unknown(little, relief, shown)
        assert unseen.detection_limit == pytest.approx(limit * score.sd, rel=1e-4)
        assert (unseen.reason == LOOKS_LIKE) == (value > 4.4)


def test_a_pump_s_flow_that_was_never_reached_is_above_what_it_gave() -> None:
    """It was told as a number that was 5,000 times less than its interval."""
    model, chunk, _ = record(seed=5)
    psi = 1e9, 0.05, 1e10
    drooping = Revision(timings=((PUMP, psi),))
    weak = one_pass(model, chunk, prepare(model, chunk), drooping, None, True)
    known, not_reached = _told(weak, (PUMP.effect, "p_supply"))
    assert set(known) == {"resistance", "stiffness"} and set(not_reached) == {"pump_flow"}
    most = not_reached["pump_flow"].value
    assert 0.3 < most / usual_demand(weak.view).max() <= 1.0
    assert "pump_flow" in parameters(weak, (PUMP.effect, "p_supply")), "the file has it"


def test_what_says_the_same_of_all_is_said_once() -> None:
    """38 rows had the same remark; of one alone its name stays."""
    bent = [Unseen(name, "a", None, "", True, MISLED) for name in ("relief_valve", "supply_sag")]
    other = Unseen("entrained_air", "both", 0.01, "1", True, "")
    told = folded([bent[0], other, bent[1]])
    assert [u.effect for u in told] == ["entrained_air", "all 2 that it was asked for"]
    assert told[1].reason == MISLED and folded(bent[:1]) == bent[:1]
