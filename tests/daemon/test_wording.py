"""Each alarm as a user reads it: one sentence that names the part, and never a dict or a list."""

from __future__ import annotations

import re

import pytest

from rtid.daemon import wording
from rtid.daemon.status import MessageHealth, SignalHealth, Verdict

SILENT = MessageHealth("Pressures", 0x121, 1000.0, verdict="silent")
LATE = MessageHealth("Motion", 0x122, 1000.0, rate_hz=500.0, verdict="late")
HIGH = SignalHealth("p_a", "pressure", "Pa", "Pressures", 4e7, -1e5, 4e7, verdict="out_of_range")
GONE = SignalHealth("x", "position", "m", "Motion", verdict="not_available")
LEAK = Verdict(0.0, "missing", "An internal leakage of 0.5 L/min at 10 MPa is missing.")

SAID = {
    "second_sender": (wording.second_sender(["Pressures"]), "Pressures comes faster"),
    "channels": (wording.several_channels({"A": 1}), "A (taken from 1)"),
    "two second senders": (wording.second_sender(["A", "B"]), "A, B come faster"),
    "frozen": (wording.frozen(["p_a"]), "p_a does not move"),
    "bus_down": (wording.bus_down("socketcan can0"), "socketcan can0 has failed"),
    "helper once": (wording.helper_failed(1), "has ended once"),
    "helper": (wording.helper_failed(3), "has ended 3 times"),
    "silent": (wording.message("silent", [SILENT, LATE]), "Pressures: no good frame comes"),
    "late": (wording.message("late", [SILENT, LATE]), "Motion: comes more slowly"),
    "range": (wording.signals([HIGH]), "it went from -100000 to 4e+07 Pa"),
    "no value": (wording.signals([GONE]), "x has no value"),
    "plant, no verdict yet": (wording.plant_changed(None), "a diagnosis follows"),
    "plant": (wording.plant_changed(LEAK), "is missing. If the machine is to stay as it is"),
    "overload": (
        wording.overload(71, 500, {"work": 2, "late": 9}),
        "71 of the last 500 ticks were lost: woken too late (9), long work (2); frames wait",
    ),
}


@pytest.mark.parametrize("name", SAID)
def test_an_alarm_is_a_sentence(name: str) -> None:
    text, part = SAID[name]
    assert part in text
    assert not re.search(r"[{}\[\]]|None|nan", text) and len(text) < 250


def test_no_alarm_without_a_reason() -> None:
    assert wording.second_sender([]) == wording.frozen([]) == wording.signals([]) == ""
    assert wording.message("damaged", [SILENT, LATE]) == ""
