"""Twenty machines of each kind: maps, bulk moduli, alarms, and what is hidden in them.

RTID_KINDS: machines per kind (20 by default).  Each is judged clean, and once with one of three
effects in it, of middle strength.  Pump-driven cylinders are those of `tests.test_drive`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.errors import RtidError
from rtid.study.quick import quick
from rtid.study.quick_rate import QuickRate
from rtid.units import show_flow_as
from tests.campaign.diagnoses import wilson
from tests.campaign.kinds import COMPENSATED, HIDDEN, KINDS, SPOOL, KindCase
from tests.campaign.laws import Outcome, outcome
from tests.campaign.laws_at_size import ALARMS, Z95
from tests.campaign.report import leave
from tests.campaign.test_laws import covered
from tests.test_drive import Driven

MACHINES = int(os.environ.get("RTID_KINDS", "20"))
FIRST, MOST_SKIPPED = 7000, 20
DRIVE_COMPLIANCE, DRIVE_LEAKAGE = "drive_compliance", "drive_leakage"


@pytest.mark.long
def test_a_spool_with_its_zero_off_raises_no_alarm() -> None:
    found = outcome(KindCase(FIRST, SPOOL))
    assert found is not None and found.verdict not in ALARMS
    assert np.abs(found.beta_z).max() < 4.0 and np.abs(found.valid.error).mean() < 0.003


@pytest.mark.campaign
def test_what_a_record_shows_that_is_too_short_for_its_grid() -> None:
    """No block is known well enough to judge by, and a leak was not even looked for."""
    found = outcome(KindCase(7011, COMPENSATED, hidden="internal_leakage_laminar"))
    assert found is not None and found.names[0] == "internal_leakage_laminar"


def machines(kind: str, hidden: bool) -> Iterator[Outcome]:
    """So many of a kind; those that leave their stroke or cavitate are drawn anew."""
    left = MACHINES
    for seed in range(FIRST, FIRST + MACHINES + MOST_SKIPPED):
        name = HIDDEN[seed % len(HIDDEN)] if hidden else ""
        found = outcome(KindCase(seed, kind, hidden=name)) if left else None
        if found is not None:
            left -= 1
            print(found.case, found.verdict, *found.names)
            yield found


def leave_clean(kind: str, found: list[Outcome]) -> tuple[float, float, int]:
    """The row of clean machines; mean error of the map, share of beta covered, alarms."""
    alarms = [o for o in found if o.verdict in ALARMS]
    beta = np.concatenate([o.beta_z for o in found])
    error = np.array([np.abs(o.valid.error).mean() for o in found])
    said = Counter(name for o in alarms for name in o.names or (o.verdict,)).most_common()
    words = (
        f"map mean {100 * error.mean():.2f} %, worst machine {100 * error.max():.2f} %; beta in "
        f"its interval {(np.abs(beta) < Z95).sum()} of {len(beta)}, largest "
        f"{np.abs(beta).max():.1f} sd; {len(alarms)} alarms"
    ) + "".join(f", {name} {n}" for name, n in said)
    leave(f"{kind}: clean", words, "0.3 %; 90 %; none", f"{len(found)} machines, 44 s")
    return float(error.mean()), covered(beta), len(alarms)


def leave_hidden(kind: str, found: list[Outcome], what: str = "leak, lag or dead volume") -> float:
    """The row of machines with something hidden in them; share of those named."""
    missed = [o for o in found if o.case.hidden not in o.names]
    hits = len(found) - len(missed)
    said = [f"; {o.case.hidden} was {' or '.join(o.names) or o.verdict}" for o in missed]
    low, high = wilson(hits, len(found))
    words = f"{hits} of {len(found)} ({100 * low:.0f} to {100 * high:.0f} %){''.join(said)}"
    row = f"{kind}: hidden {what} named, alone or in a set"
    leave(row, words, "95 %", "middle strength, rich motion")
    return hits / len(found)


@pytest.mark.campaign
@pytest.mark.parametrize("kind", KINDS)
def test_a_clean_machine_of_a_kind(kind: str) -> None:
    error, is_covered, alarms = leave_clean(kind, list(machines(kind, hidden=False)))
    assert error <= 0.003 and is_covered >= 0.9 and not alarms


@pytest.mark.campaign
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_hidden_in_a_machine_of_a_kind(kind: str) -> None:
    assert leave_hidden(kind, list(machines(kind, hidden=True))) >= 0.95


@pytest.mark.campaign
def test_cylinders_that_a_pump_drives(tmp_path: Path) -> None:
    """Clean, with a compliance, with a leakage: D of each direction, alarms, names."""
    errors, alarms, hits, refused = list[float](), list[str](), Counter[str](), list[str]()
    for k in range(MACHINES):
        rng = np.random.default_rng([61, k])
        drawn = Driven.drawn(rng, leakage=float(rng.uniform(1e-9, 3e-9)))
        clean = replace(drawn, compliance=0.0, leakage=0.0)
        kinds = {
            "": clean,
            DRIVE_COMPLIANCE: replace(drawn, leakage=0.0),
            DRIVE_LEAKAGE: replace(drawn, compliance=0.0),
        }
        for hidden, plant in kinds.items():
            table = plant.recorded(tmp_path / "pump.csv", rng, 2e6)
            try:
                looked = quick(table)
            except RtidError as error:
                refused.append(str(error).partition("\n")[0])
                continue
            assert isinstance(looked, QuickRate)
            named = {f.effect for f in looked.diagnosis.found}
            hits[hidden] += hidden in named
            alarms += [name for name in named if name != hidden]
            band = looked.bands["f"]
            turn = 2 * np.pi * np.array([band.gain_above, band.gain_below])
            errors += np.abs(turn / np.array([plant.out, plant.back]) - 1.0).tolist()
    show_flow_as("m3/s")
    said = ", ".join(f"{name} {n}" for name, n in Counter(alarms).most_common()) or "none"
    words = (
        f"D off by {100 * np.mean(errors):.2f} %, largest {100 * max(errors):.2f} %; named: "
        f"compliance {hits[DRIVE_COMPLIANCE]}, leakage {hits[DRIVE_LEAKAGE]} of {MACHINES}; "
        f"false names: {said}; refused: {len(refused)}"
    )
    what = "pump-driven cylinder: clean, with compliance, with leakage"
    leave(what, words, "0.3 %; 95 %; none", f"{3 * MACHINES} records of 60 s")
    print(refused)
    assert np.mean(errors) <= 0.003 and not alarms and not refused
    assert min(hits[DRIVE_COMPLIANCE], hits[DRIVE_LEAKAGE]) >= 0.95 * MACHINES
