"""The measured cascaded tanks: overflow is found first, and the free run follows the other record.

The record is that of nonlinearbenchmark.org (Schoukens and Noel, 2017).  Choices are made on its
identification part alone; the validation part is only looked at here.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtid.plants import refit
from rtid.plants.missing import AMBIGUOUS, MISSING
from rtid.plants.validation import on_record, rms
from rtid.project.plant_file import load_plant
from rtid.study.refit import Records, Refitted, load_records, run
from rtid.tell.refit import as_json, sentences

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[1] / "rtid" / "project" / "examples" / "cascaded_tanks.toml"


@pytest.fixture(scope="module")
def records(shared: Path) -> Records:
    return load_records(load_plant(EXAMPLE), shared / "data" / "real" / "cascaded_tanks.csv")


@pytest.fixture(scope="module")
def diagnosed(records: Records) -> Refitted:
    return run(load_plant(EXAMPLE), records, with_diagnosis=True)


def errors(records: Records, *effects: tuple[str, str]) -> tuple[float, float]:
    """Free-run error on the identification and on the validation part, V."""
    model = refit(load_plant(EXAMPLE).plant, records.identification, effects)
    assert records.validation is not None
    other = rms(on_record(model.fit, records.validation, same_start=True))
    return float(model.fit.rmse[0]), float(other[0])


def test_the_plain_equations_miss_as_much_as_by_hand(records: Records) -> None:
    assert len(records.identification.t_s) == 1024
    assert errors(records) == pytest.approx((0.603, 0.669), abs=0.002)


def test_overflow_explains_more_than_the_decoy(records: Records) -> None:
    decoy, overflow = errors(records, ("dead_zone", "u")), errors(records, ("overflow", "x1"))
    print(f"dead voltage alone {decoy}, overflow alone {overflow}")
    assert decoy == pytest.approx((0.572, 0.653), abs=0.003)
    assert overflow[0] < 0.51 and overflow[1] < 0.58


@pytest.mark.long
@pytest.mark.slow
def test_overflow_is_found_first_and_the_error_falls(diagnosed: Refitted) -> None:
    found = diagnosed.diagnosis
    assert found is not None
    before, after = diagnosed.errors(diagnosed.first), diagnosed.errors(diagnosed.last)
    for line in sentences(diagnosed):
        print(line)
    assert found.path[0][0][0] == "overflow"
    assert found.found[0].key[0] == "overflow"
    assert "dead_zone" not in {effect for effect, _ in found.found[0].alike}
    assert found.verdict in (MISSING, AMBIGUOUS)
    assert before["validation"][0] == pytest.approx(0.669, abs=0.002)
    assert after["identification"][0] <= 0.21
    assert after["validation"][0] <= 0.30


@pytest.mark.long
def test_the_report_names_what_the_diagnosis_found(diagnosed: Refitted) -> None:
    told: dict[str, Any] = json.loads(json.dumps(as_json(diagnosed), allow_nan=False))
    first = told["found"][0]
    assert first["effect"] == "overflow"
    assert {p["name"]: p["unit"] for p in first["parameters"]}["rim"] == "V"
    assert first["p_value"] < 1e-6 and first["heldout_gain_pct"] > 30
    assert {"verdict", "not_found", "negligible", "advice"} <= told.keys()
    limits = [r["detection_limit"] for r in told["not_found"] if r["visible"]]
    assert limits and all(np.isfinite(limit) and limit > 0 for limit in limits)
    assert "saturation" not in {r["effect"] for r in told["not_found"] if r["visible"]}
    assert all(r["reason"] for r in told["not_found"] if not r["visible"])
