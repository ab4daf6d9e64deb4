"""A project of `rtid quick` beside the expert's: the same verdict on the rig and on own machines.

What a user knows is given: bore, rod, stroke, dead volumes and the data sheet's lag.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from rtid.diagnose.report import Diagnosis
from rtid.project import load
from rtid.sim.random_plants import draw, draw_hidden
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.study.quick import Quick, quick
from rtid.study.quick_machine import Given
from rtid.study.study import Study
from tests.campaign.report import leave
from tests.rig import PROJECT

pytestmark = pytest.mark.campaign
FIRST, OWN, RECORD_S, LAG_S = 7000, 20, 60.0, 1.3e-3
RUNS = [f"rig_{k:02d}" for k in range(1, 17)]
HIDDEN = (
    "internal_leakage_laminar", "external_leakage_laminar", "entrained_air", "input_delay",
    "valve_hysteresis", "supply_sag", "relief_valve", "valve_gain_drift", "extra_dead_volume",
    "spool_lag_second_order",
)  # fmt: skip


def said(diagnosis: Diagnosis | None) -> tuple[str, list[str]]:
    """Verdict and names."""
    found = diagnosis.found if diagnosis else ()
    return (diagnosis.verdict if diagnosis else ""), sorted(effect.effect for effect in found)


def is_right(diagnosis: Diagnosis | None, hidden: str) -> bool:
    """Whether the truth is named, alone or in a set; of a healthy machine (""), nothing is."""
    found = diagnosis.found if diagnosis else ()
    alike = {name.partition(" (")[0] for e in found for name in e.cannot_be_told_from}
    names = alike | {effect.effect for effect in found}
    return hidden in names if hidden else said(diagnosis) == ("matches", [])


def beside(
    trace: Path, project: Path, given: Given, folder: Path, hidden: str | None = None
) -> tuple[bool, bool]:
    """Whether both verdicts are the same, and that of the saved project too; and right."""
    looked = quick(trace, None, given)
    assert isinstance(looked, Quick)
    saved = folder / f"{trace.stem}.quick.toml"
    saved.write_text(looked.text_for(saved), "utf-8")
    assert said(Study(saved, trace).diagnosis()) == said(looked.diagnosis)
    expert, own = said(Study(load(project), trace).diagnosis()), said(looked.diagnosis)
    right = hidden is not None and is_right(looked.diagnosis, hidden)
    told = f"hidden {hidden}: expert {expert}, quick {own}, right: {right}"
    print(f"{trace.stem}: {told}", flush=True)
    return expert == own, right


@pytest.mark.parametrize("run", RUNS)
def test_the_rig_s_runs_get_the_expert_s_verdict(shared: Path, tmp_path: Path, run: str) -> None:
    trace = shared / "data" / "rig" / "measured" / f"{run}.parquet"
    given = Given(0.05, 0.036, 0.5, (6e-4, 6e-4), None, LAG_S)
    assert beside(trace, PROJECT, given, tmp_path)[0]


def test_own_machines_get_the_expert_s_verdict(tmp_path: Path) -> None:
    """Every second one healthy, the others each with another effect."""
    same = right = 0
    for k in range(OWN):
        seed, hidden = FIRST + k, HIDDEN[k // 2 % len(HIDDEN)]
        hidden = hidden if k % 2 else ""
        plant = draw_hidden(seed, hidden) if hidden else draw(seed)
        run = simulate(plant, "rich_record", seed, RECORD_S)
        trace, _, project = write_run(tmp_path / f"m{k}.parquet", run, seed, "rich_record")
        c = plant.constants
        bore_m = math.sqrt(4 / math.pi * c.area_a_m2)
        rod_m = math.sqrt(bore_m**2 - 4 / math.pi * c.area_b_m2)
        volumes = c.v0_a_m3, c.v0_b_m3
        given = Given(bore_m, rod_m, c.stroke_m, volumes, None, LAG_S)
        is_same, knows = beside(trace, project, given, tmp_path, hidden)
        same, right = same + is_same, right + knows
    leave("project of rtid quick: the expert's verdict", f"{same} of {OWN}", "all", "own machines")
    leave("project of rtid quick: right, alone or in a set", f"{right} of {OWN}", "all", "the same")
    assert same == OWN
    assert right == OWN
