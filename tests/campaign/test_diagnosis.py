"""The diagnosis over random machines: false alarms, names, and effects that nobody has listed.

RTID_DIAGNOSES: machines per effect (8 of each by default; about half a minute each).  Every outcome
also leaves a line in out/campaign/diagnoses.csv, and a picture of what was named for what.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

from rtid.sim.hidden import MECHANICAL, OUTSIDE
from rtid.sim.hideable import LEVELS
from tests.campaign.confusion import confusion, keep
from tests.campaign.diagnoses import (
    IN_SET,
    NEGLIGIBLE,
    NONE,
    RIGHT,
    UNKNOWN,
    WRONG,
    Case,
    Outcome,
    outcomes,
    wilson,
)
from tests.campaign.report import leave

MACHINES = int(os.environ.get("RTID_DIAGNOSES", "8"))
FIRST = 400
TWELVE = (
    "internal_leakage_laminar", "external_leakage_laminar", "valve_seat_leakage", "entrained_air",
    "extra_dead_volume", "line_dynamics", "spool_lag_second_order", "input_delay",
    "valve_hysteresis", "supply_sag", "relief_valve", "valve_gain_drift",
)  # fmt: skip
PAIRED = (
    "internal_leakage_laminar", "external_leakage_laminar", "entrained_air", "input_delay",
    "valve_hysteresis", "supply_sag", "relief_valve", "valve_gain_drift",
)  # fmt: skip

pytestmark = pytest.mark.campaign


def drawn(
    effects: tuple[str, ...], level: str = "middle", motion: str = "rich_record"
) -> list[Outcome]:
    cases = [Case(FIRST + k, effect, level, motion) for k in range(MACHINES) for effect in effects]
    found = list(outcomes(cases))
    keep(found)
    return found


def share(result: list[Outcome], *judgements: str) -> tuple[int, str]:
    """How many are judged so, and the words for it."""
    hits = sum(o.judgement in judgements for o in result)
    low, high = wilson(hits, len(result))
    return hits, f"{hits} of {len(result)} ({100 * low:.0f} to {100 * high:.0f} %)"


def test_nothing_is_named_where_nothing_is_hidden() -> None:
    """Clean records and changes of the mechanics: at most 1 % false alarms."""
    found = drawn((NONE, *MECHANICAL))
    hits, words = share(found, WRONG, UNKNOWN)
    leave("false alarms, clean and mechanical changes", words, "at most 1 %", "random machines")
    assert hits <= 0.01 * len(found)


@pytest.mark.parametrize("level", LEVELS)
def test_effects_of_the_catalogue_are_named(level: str) -> None:
    """Right, in an honest set, or listed as negligible: at least 97 %; sizes within 15 %."""
    found = drawn(TWELVE, level)
    confusion(found, f"{level}, rich motion")
    hits, words = share(found, RIGHT, IN_SET, NEGLIGIBLE)
    wrong = sorted({f"{o.case.effect} as {o.named}" for o in found if o.judgement == WRONG})
    basis = f"{MACHINES} machines x {len(TWELVE)}, rich motion"
    rest = f"; a wrong name: {', '.join(wrong)}" if wrong else ""
    leave(f"twelve hidden effects, {level}: found or negligible", words + rest, "97 %", basis)
    off = np.abs([o.size - 1.0 for o in found if np.isfinite(o.size)])
    sizes = f"median {100 * np.median(off):.1f} %, largest {100 * off.max():.0f} %"
    leave(f"their sizes, {level}", sizes, "median 10 %", f"{len(off)} of one parameter")
    assert hits >= 0.97 * len(found)
    assert np.median(off) <= 0.1


def test_two_effects_at_once_are_both_found() -> None:
    """Both in at least 85 %, a false third in at most 10 %."""
    rng = np.random.default_rng(FIRST)
    pairs = [rng.choice(PAIRED, 2, replace=False) for _ in range(4 * MACHINES)]
    cases = [Case(FIRST + k, str(a), second=str(b)) for k, (a, b) in enumerate(pairs)]
    found = list(outcomes(cases))
    keep(found)
    both, words = share(found, RIGHT)
    third, third_words = share(found, WRONG)
    leave("two hidden effects: both found", words, "85 %", "rich, middle, eight of the twelve")
    leave("two hidden effects: a false third", third_words, "10 %", "rich, middle")
    assert both >= 0.85 * len(found)
    assert third <= 0.1 * len(found)


def test_on_the_paper_s_sweep_nothing_gets_a_false_name() -> None:
    """Most effects cannot be seen there: right, negligible or nothing, and no false name."""
    found = drawn(("none", *TWELVE), motion="sweep")
    confusion(found, "middle, sweep")
    wrong, words = share(found, WRONG)
    _, named = share(found, RIGHT, IN_SET)
    leave("the paper's sweep: a wrong name", words, "5 %", "twelve effects and none, middle")
    leave("the paper's sweep: named", named, "", "twelve effects and none, middle")
    assert wrong <= 0.05 * len(found)


def test_what_is_not_in_the_catalogue_gets_no_name() -> None:
    """Unknown in at least 90 %, a confident wrong name in at most 5 %."""
    found = drawn(tuple(OUTSIDE))
    found = [o for o in found if o.judgement != NEGLIGIBLE]  # nothing to be seen in their motion
    unknown, words = share(found, UNKNOWN)
    wrong, wrong_words = share(found, WRONG)
    leave("effects outside the catalogue: no name", words, "at least 90 %", "rich, middle")
    leave("effects outside the catalogue: a wrong name", wrong_words, "at most 5 %", "rich, middle")
    assert unknown >= 0.9 * len(found)
    assert wrong <= 0.05 * len(found)
