"""From which size on an effect is named: a clean record says it, one with the effect shows it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtid.diagnose import nameable, summary
from rtid.diagnose.lag_interval import LagInterval
from rtid.diagnose.nameable import Reach, clearest
from rtid.diagnose.regression import LIMIT_SD, Score
from rtid.diagnose.report import NOT_CONFIRMED, Small, Unseen, Value
from rtid.effects import effect
from rtid.effects.column import of_page
from rtid.model import Lag
from rtid.sim.declare import declared_model
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.tell.diagnosed import in_the_moduli, sentences
from tests.campaign.diagnoses import IN_SET, RIGHT
from tests.campaign.laws import Case, answer, judged

RICH = "rich_record"
SHARES = st.floats(1e-3, 1e3)


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "law", "effect", "where"),
    [
        (6201, "laminar", "external_leakage_laminar", "a"),
        (6202, "asymmetric", "internal_leakage_laminar", "a-b"),
    ],
)
def test_twice_the_size_is_named_and_what_is_not_significant_is_not(
    seed: int, law: str, effect: str, where: str
) -> None:
    clean = judged(Case(seed, law, RICH))
    assert clean is not None and clean.said.verdict == "matches"
    (limit,) = (u for u in clean.said.not_found if (u.effect, u.where) == (effect, where))
    assert limit.named_from is not None and limit.detection_limit is not None
    sizes = 2.0 * limit.named_from, 0.5 * limit.detection_limit
    named, passed = (answer(Case(seed, law, RICH, effect, size)) for size in sizes)
    assert named is not None and named.judgement in (RIGHT, IN_SET)
    assert passed is not None and passed.verdict == "matches"


@given(st.floats(1e-15, 1e-9), SHARES, SHARES, SHARES, SHARES)
def test_it_is_significant_and_no_smaller_where_less_is_left(
    sd: float, left: float, own: float, bend: float, softer: float
) -> None:
    reach = Reach(sd, left / sd, own / sd, bend / sd, softer / sd)
    assert reach.named_from >= LIMIT_SD * sd
    weaker = Reach(sd, 0.5 * left / sd, 0.5 * own / sd, 0.5 * bend / sd, 0.5 * softer / sd)
    assert weaker.named_from >= reach.named_from
    beside = replace(reach, left=0.0, gain=1e4)  # less may be what a clear effect's law leaves
    assert beside.named_from >= 1e2 * sd
    assert Reach(sd, 0.0, np.inf, 0.0, 0.0).named_from > 1e290, "nothing that matters: never"


AIR = "entrained_air", "both"


def test_a_limit_holds_for_every_exponent_that_it_is_not_told_with() -> None:
    """3 % of air of exponent 1.3 were passed over where 0.025 was the limit, of exponent 1.4."""
    air = of_page(effect(AIR[0]), AIR[1], shape=("polytropic_exponent",))
    sizes = {1.0: (0.0534, 0.0031), 1.2: (0.0338, 0.0020), 1.4: (0.0251, 0.0015)}
    scores = [
        (replace(air, shape=(kappa,)), Score(k, size, sd, 288.0, 0.05))
        for k, (kappa, (size, sd)) in enumerate(sizes.items())
    ]
    (told,) = clearest(scores).values()
    assert told == scores[0]


def test_of_a_volume_the_limit_is_that_of_one_that_is_not_late() -> None:
    volume = of_page(effect("extra_dead_volume"), "a", shape=("port_lag",))
    at_once, late = (replace(volume, shape=(lag_s,)) for lag_s in (0.0, 4e-3))
    scores = [(late, Score(0, 1e-4, 1e-6, 99.0, 0.1)), (at_once, Score(1, 1e-4, 2e-6, 99.0, 0.1))]
    assert clearest(scores) == {volume.key: scores[1]}


@given(st.floats(5.0, 1e3), st.floats(1e-6, 1e-3))
def test_what_is_not_believed_is_no_larger_than_its_limit(deviations: float, sd: float) -> None:
    """The truth is within its interval, and so must the limit be no less than its upper end."""
    reach = Reach(sd, 0.0, 0.0, 0.0, 1.0 / sd, moved=2.0)
    limit = reach.not_believed(Score(0, -deviations * sd, sd, deviations**2, 0.1))
    assert limit >= (deviations + 1.95) * sd
    assert reach.not_believed(Score(0, 2.0 * sd, sd, 4.0, 0.1)) == 0.0


def test_a_modulus_that_counts_what_is_not_named_is_said_to() -> None:
    clean = judged(Case(6201, "laminar", RICH))
    assert clean is not None and not in_the_moduli(clean.said)
    (air,) = (u for u in clean.said.not_found if (u.effect, u.where) == AIR)
    assert air.moves_beta is None and air.seen is None
    reach = Reach(1e-3, 0.0, 0.0, 0.0, softer=0.5, moved=2.0)
    moves = reach.beyond_interval(-0.03)
    assert moves == pytest.approx(0.06) and reach.beyond_interval(0.01) is None
    doubtful = Unseen(
        *AIR, 0.04, "1", True, NOT_CONFIRMED, seen=Value(0.03, 1e-3, "1"), moves_beta=moves
    )
    said = replace(clean.said, negligible=(Small(*AIR, 1e-4),), not_found=(doubtful,))
    text = " ".join(sentences(said))
    assert "Seen, not confirmed" in text and "Too small to matter" not in text
    assert "Entrained air (both) of 0.03" in text, "what was seen, and not its limit"
    assert "The moduli are effective ones" in text and "(6 %)" in text


def test_an_interval_of_a_modulus_holds_what_is_seen_and_not_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of hoses that nothing confirmed 532 +- 7 MPa were told, of 835; each moved it by 40 %."""
    monkeypatch.setattr(summary, "counted", lambda _: np.diag([1e-24, 1e-24]))
    last: Any = SimpleNamespace(
        rho=1.0, most_rho=1.1, compliance=np.array([2e-9, 1e-9]),
        declared=declared_model(SimulatedPlant()),
    )  # fmt: skip
    late = LagInterval(1e-4, np.zeros(2))
    hose = Unseen("hose_compliance", "a", 2.5e-13, "m3/Pa", True, NOT_CONFIRMED, moves_beta=0.4)
    plain = summary._sd_of_moduli(last, late, ())
    assert plain == pytest.approx((1e-12 / 4e-18, 1e-12 / 1e-18))
    a, b = summary._sd_of_moduli(last, late, (hose,))
    assert a == pytest.approx(0.4 / 2e-9, rel=1e-3) and b == plain[1]
    wider = summary._sd_of_moduli(last, LagInterval(1e-4, np.array([3e-12, 0.0])), ())
    assert wider == pytest.approx((np.sqrt(10.0) * plain[0], plain[1]))
    last.compliance = np.array([2e-9, -1e-10])
    assert summary.moduli(last.compliance) == pytest.approx((5e8, np.inf))
    assert np.isnan(summary._sd_of_moduli(last, late, ())).tolist() == [False, True]
    assert np.isnan(summary._sd_of_moduli(last, None, ())).all()


def test_a_lag_that_stands_in_for_what_is_missing_has_no_interval(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At three tolerances, and beside a misfit: 6.016 +- 0.13 ms were told of 3.76."""
    monkeypatch.setattr(summary, "known_lag", lambda _: LagInterval(1e-4, np.zeros(2)))

    def told(lag_s: float, rho: float = 1.0, verdict: str = "matches") -> float:
        last: Any = SimpleNamespace(
            rho=rho, most_rho=1.1, lag_tolerance_s=1e-3, weights=SimpleNamespace(lag_s=lag_s),
            declared=SimpleNamespace(lag=Lag(3e-3, 1e-3)),
        )  # fmt: skip
        result: Any = SimpleNamespace(verdict=verdict, last=last)
        return summary._sd_of_lag(last, summary._late(result, last))

    assert told(4e-3) == told(5.9e-3, 1.4, "missing") == 1e-4
    wrong = told(6e-3), told(4e-3, 2.1), told(4e-3, 1.2, "unknown")
    assert np.isnan(wrong).all()


def test_what_is_stored_is_known_no_better_than_the_modulus_beside_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Air was "seen from" 0.1 % on beside 1.1 +- 630 GPa, and 0.45 % were there."""
    monkeypatch.setattr(nameable, "counted", lambda _: np.diag([1e-22, 4e-24]))
    fit: Any = SimpleNamespace(
        declared=declared_model(SimulatedPlant()), compliance_cov=np.diag([1e-24, 4e-24])
    )
    causes = ("entrained_air", "a"), ("entrained_air", "b"), ("internal_leakage_laminar", "a-b")
    asked = [(of_page(effect(name), where), Score(1, 0.0, 2.0, 0.0, 1.0)) for name, where in causes]
    assert [s.sd for _, s in nameable.known_as_moduli(fit, asked)] == pytest.approx(
        [20.0, 2.0, 2.0]
    )
    fit.declared = replace(fit.declared, chambers=(replace(fit.declared.chambers[0], pressure=""),))
    assert nameable.known_as_moduli(fit, asked) is asked
