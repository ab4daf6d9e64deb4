"""The benchmark "what is missing?", small: a record, three methods, what their answers count."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from benchmarks.missing import methods, plants
from benchmarks.missing.__main__ import gathered, settings_of, versions, write_records
from benchmarks.missing.collect import digest, file_of, one_case
from benchmarks.missing.methods import BASE, FILES, methods_of
from benchmarks.missing.methods.data_sheet import predicted
from benchmarks.missing.page import Measured, head, of_losses, of_maps, of_names
from benchmarks.missing.plants import PLANTS
from benchmarks.missing.record import (
    NOTHING,
    OUTSIDE,
    SMALL,
    UNKNOWN,
    Case,
    Learned,
    Names,
    NotForThisError,
    Record,
)
from benchmarks.missing.score import (
    ALARM,
    AMONG,
    FAILED,
    IN_SET,
    QUIET,
    RIGHT,
    SILENT,
    UNKNOWN_WORD,
    WRONG,
    judged,
    unseen_error,
)

THREE = ("data sheet", "least squares", "rtid")
LEAK, DELAY, LAG = "internal_leakage_laminar", "input_delay", "spool_lag_second_order"


@cache
def case() -> Case:
    with TemporaryDirectory() as name:
        (drawn,) = write_records(Path(name), 7, SMALL, ("own_simulator",))
    return drawn


@pytest.mark.long
@pytest.mark.slow
def test_three_methods_answer_and_their_tables_are_written(tmp_path: Path) -> None:
    """A strong leak: the map alone cannot have it, rtid names it and predicts best."""
    scores, cases = {}, write_records(tmp_path, 7, SMALL, ("own_simulator",))
    (tmp_path / "results").mkdir()
    name = next((tmp_path / "records").glob("*.pickle")).stem
    for method in THREE:
        scores[method] = one_case(cases[0], methods_of(BASE)[method])
        line = {"case": name, "method": method, "memory_mib": 1.0} | scores[method]
        file_of(tmp_path, method).write_text(json.dumps(line) + "\n")
    sheet, linear, ours = (scores[method]["unseen"] for method in THREE)
    assert ours < 0.01 < linear < sheet
    assert scores["rtid"]["judgement"] == RIGHT and scores["rtid"]["named"] == [[LEAK]]
    assert scores["rtid"]["map_error"] < 0.005 and scores["rtid"]["beta_error"] < 0.02
    whole = tmp_path / "result.json"
    whole.write_text(json.dumps(gathered(tmp_path, 7, SMALL, cases, list(THREE), BASE)))
    measured = Measured(whole)
    for lines in (of_maps(measured), of_names(measured), of_losses(measured), head(measured)):
        assert "|" in (text := "\n".join(lines)) or "minutes" in text
    assert measured.whole["versions"].keys() <= versions().keys()
    assert measured.whole["cases"][name]["sha256"] == digest(case())


def test_who_knows_the_truth_predicts_it() -> None:
    """What is scored is the model: the true map misses the leak and next to nothing else."""
    truth, test = case().truth, case().test
    assert unseen_error(case(), truth.target) == 0.0
    assert unseen_error(case(), np.full_like(truth.target, np.nan)) == np.inf
    assert truth.flow is not None
    beta_pa = np.full(2, truth.beta_pa)
    left = predicted(test, truth.flow, beta_pa) - truth.target
    volume_flow = left * truth.scale  # a share of the rms flow
    p_a, p_b = test.column("p_a"), test.column("p_b")
    for c, sign in enumerate((1.0, -1.0)):
        leak, rest = sign * (p_a - p_b), volume_flow[50:-1, c]
        whole = leak[50:-1] * (leak[50:-1] @ rest) / (leak[50:-1] @ leak[50:-1])
        assert np.std(rest - whole) < 0.25 * np.sqrt(np.mean(rest**2))


@pytest.mark.parametrize(
    ("effect", "missing", "word"),
    [
        ("", NOTHING, QUIET),
        ("", UNKNOWN, ALARM),
        (LEAK, NOTHING, SILENT),
        (LEAK, UNKNOWN, UNKNOWN_WORD),
        (LEAK, (frozenset({LEAK}),), RIGHT),
        (DELAY, (frozenset({DELAY, LAG}),), IN_SET),
        (DELAY, (frozenset({DELAY}), frozenset({LEAK})), AMONG),
        (DELAY, (frozenset({DELAY, LAG, LEAK, "x"}),), WRONG),
        (DELAY, (frozenset({LEAK}),), WRONG),
        (OUTSIDE, (frozenset({LEAK}),), WRONG),
        (OUTSIDE, UNKNOWN, UNKNOWN_WORD),
    ],
)
def test_what_names_are_worth(effect: str, missing: Names, word: str) -> None:
    assert judged(effect, missing) == word


class Breaks:
    """A method that breaks off."""

    says_names = True

    def name(self) -> str:
        return "breaks"

    def learn(self, train: Record) -> Learned:
        raise ZeroDivisionError("on purpose")


def test_a_method_that_breaks_off_is_a_result() -> None:
    line = one_case(case(), Breaks())
    assert line["judgement"] == FAILED and line["unseen"] is None
    assert line["failed"] == "ZeroDivisionError: on purpose"


def test_a_record_of_another_kind_is_refused() -> None:
    with pytest.raises(NotForThisError, match="valves"):
        _ = replace(case().train, declared=case().train.machine).plant_file


def test_every_file_is_in_its_list() -> None:
    """Of methods and of plants; `valve_records` is what plants share."""
    there = {p.stem for p in Path(methods.__path__[0]).glob("*.py")} - {"__init__"}
    assert there == set(FILES)
    there = {p.stem for p in Path(plants.__path__[0]).glob("*.py")}
    assert there - {"__init__", "valve_records"} == set(PLANTS)


def test_settings_are_told() -> None:
    """What the author of a method has chosen stands in the result."""
    told = settings_of(methods_of(BASE)["least squares"])
    assert told["KNOTS"] == 14 and "METHODS" not in told
