"""The diagnosis over random machines: false alarms, names, and effects that nobody has listed.

RTID_DIAGNOSES: machines per effect (8 of each by default; about half a minute each).
"""

from __future__ import annotations

import os

import pytest

from rtid.sim.hidden import MECHANICAL, OUTSIDE
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

pytestmark = pytest.mark.campaign


def drawn(effects: tuple[str, ...], level: str = "middle") -> list[Outcome]:
    cases = [Case(FIRST + k, effect, level) for k in range(MACHINES) for effect in effects]
    return list(outcomes(cases))


def share(found: list[Outcome], *judgements: str) -> tuple[int, str]:
    """How many are judged so, and the words for it."""
    hits = sum(o.judgement in judgements for o in found)
    low, high = wilson(hits, len(found))
    return hits, f"{hits} of {len(found)} ({100 * low:.0f} to {100 * high:.0f} %)"


def test_nothing_is_named_where_nothing_is_hidden() -> None:
    """Clean records and changes of the mechanics: at most 1 % false alarms."""
    found = drawn((NONE, *MECHANICAL))
    hits, words = share(found, WRONG, UNKNOWN)
    leave("false alarms, clean and mechanical changes", words, "at most 1 %", "random machines")
    assert hits <= 0.01 * len(found)


def test_effects_of_the_catalogue_are_named() -> None:
    """Right, in an honest set, or listed as negligible: at least 97 %."""
    found = drawn(TWELVE)
    for effect in TWELVE:
        own = [o for o in found if o.case.effect == effect]
        counts = {j: sum(o.judgement == j for o in own) for j in (RIGHT, IN_SET, NEGLIGIBLE)}
        rest = len(own) - sum(counts.values())
        words = ", ".join(f"{n} {j}" for j, n in counts.items() if n) + f", {rest} other" * (
            rest > 0
        )
        leave(f"hidden: {effect}, middle", words, "", f"{len(own)} machines, rich motion")
    hits, words = share(found, RIGHT, IN_SET, NEGLIGIBLE)
    leave("twelve hidden effects, found or negligible", words, "at least 97 %", "rich, middle")
    assert hits >= 0.97 * len(found)


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
