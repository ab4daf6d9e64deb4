"""What the page says: sizes in the units of the workshop, the next step after every verdict."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rtid.diagnose.remains import _what
from rtid.diagnose.report import Value
from rtid.tell.diagnosed import heading, said
from rtid.tell.html import clearness, error_bars
from rtid.tell.report_story import Ranked, sizes_say
from rtid.tell.words import is_floor, quantity
from rtid.ui.desk import RankedDiagnosis
from rtid.ui.why_view import _ranking, fragments
from rtid.units import limit
from tests.ui.test_session import KEY, told

NAN = float("nan")


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (Value(2e-12, 1e-14, "m3/s/Pa"), "0.12 ± 0.0012 L/min/MPa"),
        (Value(1e-9, NAN, "m3/s/sqrt(Pa)"), "0.06 L/min/sqrt(MPa)"),
        (Value(1e-12, NAN, "m3/Pa"), "1 cm3/MPa"),
        (Value(1.2e9, NAN, "Pa s/m3"), "0.02 MPa/(L/min)"),
        (Value(5e-3, 1e-5, "s"), "5 ± 0.02 ms"),
        (Value(5.2e6, NAN, "Pa"), "5.2 MPa"),
        (Value(0.02, NAN, "1"), "0.02"),
    ],
)
def test_sizes_are_in_the_units_of_the_workshop_with_their_interval(
    value: Value, words: str
) -> None:
    assert quantity(value) == words


def test_a_limit_has_two_digits() -> None:
    assert limit(1.7061e-14, "m3/s/Pa") == "0.001 L/min/MPa"
    assert limit(2.0684e-5, "s") == "0.021 ms"


def test_what_was_found_is_named_with_its_size_and_the_fall_of_the_error() -> None:
    words = said(told(KEY).diagnosis)
    assert words == (
        "Internal leakage, laminar at a-b, 0.12 ± 0.0012 L/min/MPa (95 %). Adding it lowers the "
        "held-out error from 2.00 % to 0.20 %; the sensors' floor is 0.10 %. What remains is the "
        "sensors' noise: no model could be much better."
    )


def test_a_floor_of_nothing_is_no_floor() -> None:
    """Where one disturbance stands for all that the command does not say, no sensor has a part."""
    diagnosis = replace(told(KEY).diagnosis, noise_floor_m3s=0.0)
    assert "from 2.00 % to 0.20 %. " in said(diagnosis) and "floor" not in said(diagnosis)
    assert [is_floor(share) for share in (None, NAN, 0.0, 0.005, 0.006)] == [False] * 4 + [True]


def test_a_set_leaves_the_choice_to_the_user() -> None:
    words = said(told(KEY, alike=("hose_compliance (b)",)).diagnosis)
    assert "cannot tell it from hose compliance: the choice is yours" in words


@pytest.mark.parametrize(
    ("verdict", "part"),
    [
        ("matches", "The held-out error is 2.00 % of the rms flow"),
        ("unknown", "Next: Where shows which signals it follows"),
        ("insufficient_data", "Next: record a minute or more"),
    ],
)
def test_every_verdict_says_what_it_stands_on_or_what_to_do(verdict: str, part: str) -> None:
    assert part in said(replace(told().diagnosis, verdict=verdict))


def test_no_signals_are_promised_where_it_follows_none() -> None:
    """The promise stood beside the advice that it follows none of them."""
    alone = replace(told().diagnosis, verdict="unknown", advice=(_what([]),))
    assert "follows none of the signals" in alone.advice[0]
    assert "Next: Where shows in which blocks and when it is largest" in said(alone)
    assert "which signals it follows" not in said(alone)


def test_errors_of_the_part_that_taught_the_model_are_called_so() -> None:
    found = replace(told(KEY).diagnosis, held_out_judged=False)
    assert "held-out" not in said(found)
    assert "the error on the motion it was taught by from 2.00 % to 0.20 %" in said(found)


def test_the_ranking_says_beside_what_its_sizes_are_fitted() -> None:
    """It said "added alone" above sizes that were fitted with what was found in the model."""
    leak = Ranked(KEY, 1216.0, None, 2e-12, 1e-14, "m3/s/Pa")
    rival = Ranked(("hose_compliance", "b"), 900.0, 2.0, 1e-15, 5e-16, "m3/Pa")
    beside, alone = (
        _ranking(RankedDiagnosis(told(*found).diagnosis, ranks), may_add=False)
        for found, ranks in (((KEY,), (leak, rival)), ((), (replace(rival, after=900.0),)))
    )
    assert "Each size is what is left of it once what was found is in the model" in beside
    assert "Each size is that of the effect added alone." in alone
    assert "Each coefficient is what is left" in sizes_say((leak, rival), "coefficient")


def test_bars_are_as_long_as_their_errors() -> None:
    html = error_bars([("before", 2.0, False), ("after", 0.5, False)], 0.25)
    assert 'width:89.29%;--from:100.00%" data-error="2.0000"' in html
    assert 'width:22.32%;--from:89.29%" data-error="0.5000"' in html
    assert html.count('class="floor" style="left:11.16%"') == 2
    assert "floor" not in error_bars([("before", 2.0, False)], NAN)


def test_clearness_tells_what_is_left_once_the_cause_is_in_the_model() -> None:
    assert clearness(1216.0, 13.4, 1293.0)[0] == "1216 → 13"
    assert clearness(22.4, 22.0, 1293.0)[0] == "22.4"
    assert 'class="clear own" style="width:150px"' in clearness(1293.0, None, 1293.0)[1]


def test_why_does_not_say_again_what_stands_above_every_view() -> None:
    """A model that matches, was told in the same sentences twice."""
    for ranked in (told(), told(KEY)):
        shown = fragments(ranked, "", may_add=True)["ranking"]
        assert said(ranked.diagnosis) not in shown
        assert heading(ranked.diagnosis)[1] not in shown
