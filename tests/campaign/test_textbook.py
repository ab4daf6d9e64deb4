"""Machines as Modelica text compiled by rumoca: maps, moduli, alarms, and what is hidden in them.

RTID_TEXTBOOK: machines per kind (3 by default; 20 motors: RTID_TEXTBOOK=20 ... -k motor).
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rtid.study.quick import quick
from rtid.study.quick_rate import QuickRate
from rtid.units import show_flow_as
from tests.campaign.laws import Judged, Outcome, of_run, outcome_of
from tests.campaign.modelica import LAG, LEAK, MOTOR, TEXTBOOK, VOLUME, Textbook
from tests.campaign.modelica_drive import DriveByText
from tests.campaign.report import leave
from tests.campaign.test_kinds import leave_clean, leave_hidden

MACHINES = int(os.environ.get("RTID_TEXTBOOK", "3"))
FIRST, MOST_SKIPPED = 7100, 10


def runs(kind: str, hidden: str) -> Iterator[tuple[Textbook, Judged]]:
    """So many machines of a kind; those that cavitate or leave their stroke are drawn anew."""
    left = MACHINES
    for seed in range(FIRST, FIRST + MACHINES + MOST_SKIPPED):
        plant = Textbook(kind, seed, hidden)
        run = plant.run() if left else None
        if run is not None:
            left -= 1
            yield plant, of_run(plant, run, plant.machine)


def machines(kind: str, hidden: str) -> list[Outcome]:
    """What was said of each, beside the truth."""
    return [outcome_of(plant, found, time.process_time()) for plant, found in runs(kind, hidden)]


@pytest.mark.campaign
@pytest.mark.parametrize("kind", TEXTBOOK)
def test_a_clean_machine_of_the_textbook(kind: str) -> None:
    found = machines(kind, "")
    error, is_covered, alarms = leave_clean(f"textbook {kind}", found)
    assert len(found) == MACHINES and error <= 0.003 and is_covered >= 0.9 and not alarms


@pytest.mark.campaign
@pytest.mark.parametrize("kind", TEXTBOOK)
def test_what_is_hidden_in_a_machine_of_the_textbook(kind: str) -> None:
    """But for a volume beside a motor's, which is a softer oil: see below."""
    hidden = (LEAK, LAG) if kind == MOTOR else (LEAK, LAG, VOLUME)
    found = [o for effect in hidden for o in machines(kind, effect)]
    for o in found:
        print(o.case.hidden, o.case.seed, o.verdict, *o.names)
    assert len(found) == len(hidden) * MACHINES
    what = "leak or lag" if kind == MOTOR else "leak, lag or dead volume"
    assert leave_hidden(f"textbook {kind}", found, what) >= 0.95


@pytest.mark.campaign
def test_a_volume_beside_a_motor_s_is_a_softer_oil() -> None:
    """It does not change with the motion: beta V / (V + V'), and the model matches."""
    for plant, found in runs(MOTOR, VOLUME):
        c, more_m3 = plant.drawn.constants, plant.hidden_size(VOLUME)
        softer = [plant.beta_pa * own / (own + more_m3) for own in (c.v0_a_m3, c.v0_b_m3)]
        assert found.said.verdict == "matches"
        np.testing.assert_allclose(found.said.beta_pa, softer, rtol=0.01)


@pytest.mark.campaign
def test_a_drive_of_the_textbook(tmp_path: Path) -> None:
    """Displacement and leakage of a closed circuit, whose oil is a compliance over the stroke."""
    errors, sizes, false = list[float](), list[float](), 0
    for seed in range(MACHINES):
        for leaks in (False, True):
            rng = np.random.default_rng([71, seed])
            plant = DriveByText.drawn(rng, leaks)
            looked = quick(plant.recorded(tmp_path / "drive.csv", rng))
            assert isinstance(looked, QuickRate)
            band, found = looked.bands["f"], looked.diagnosis.found
            turns = 2 * np.pi * np.array([band.gain_above, band.gain_below])
            errors += np.abs(turns / plant.out - 1.0).tolist()
            leakage = [f for f in found if f.effect == "drive_leakage"]
            false += len(leakage) * (not leaks)
            true = plant.leak / plant.area
            sizes += [f.parameters["coefficient"].value / true - 1.0 for f in leakage if leaks]
    show_flow_as("m3/s")
    words = (
        f"D off by {100 * np.mean(errors):.2f} %, largest {100 * max(errors):.2f} %; leakage named "
        f"at {len(sizes)} of {2 * MACHINES} ports, {100 * np.abs(sizes).max():.1f} % off at most; "
        f"{false} false ones"
    )
    limit = "0.3 %; 95 %; none"
    leave("textbook pump-driven cylinder, with and without leakage", words, limit,
          f"{2 * MACHINES} records of 60 s")  # fmt: skip
    assert np.mean(errors) <= 0.003 and len(sizes) == 2 * MACHINES and not false
