"""From which size on an effect is named: a clean record says it, one with the effect shows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtid.diagnose.nameable import Reach
from rtid.diagnose.regression import LIMIT_SD
from tests.campaign.diagnoses import IN_SET, RIGHT
from tests.campaign.laws import Case, answer, judged

RICH = "rich_record"
SHARES = st.floats(1e-3, 1e3)


@pytest.mark.parametrize(
    ("seed", "law", "effect", "where"),
    [
        (6201, "laminar", "external_leakage_laminar", "a"),
        pytest.param(
            *(6202, "asymmetric", "internal_leakage_laminar", "a-b"), marks=pytest.mark.long
        ),
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
