"""What the tests share is what they would have made: the same, made once, and never mixed up."""

from __future__ import annotations

import os
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest

from rtid.diagnose.trials import TrialState
from rtid.effects.record_view import RecordView
from rtid.plain import silent
from rtid.project import load
from tests.left import OF_RUN
from tests.replays import _digest, _once

MODEL = load(Path(__file__).parents[1] / "rtid/project/examples/cylinder.toml").model


def adding(number: float) -> Callable[[float], float]:
    """A law with a number of its own."""
    return lambda x: x + number


def digest(*given: object) -> str:
    return _digest("", given, [])


def test_laws_are_told_apart_by_what_they_do() -> None:
    assert digest([adding(1.0)]) == digest([adding(1.0)])
    assert digest([adding(1.0)]) != digest([adding(2.0)])
    assert digest([adding(1.0)]) != digest([digest])
    assert digest(1.0, adding) == digest(1.0, digest), "whom to tell does not count"


def test_what_was_worked_out_or_copied_meanwhile_does_not_count() -> None:
    chunk = np.arange(12.0).reshape(3, 4)
    fresh, asked = (RecordView.without_map(MODEL, chunk) for _ in range(2))
    assert asked.step_s == 4.0
    assert digest(fresh, fresh) == digest(asked, asked) == digest(fresh, deepcopy(asked))
    assert digest(fresh, fresh) != digest(fresh, RecordView.without_map(MODEL, chunk + 1.0))


def test_whoever_hears_of_a_search_it_is_the_same() -> None:
    chunk = np.zeros((2, 9))
    heard, unheard = (TrialState(MODEL, chunk, chunk, by) for by in (lambda *_: None, silent))
    assert digest([heard]) == digest([unheard])
    assert digest([heard]) != digest([TrialState(MODEL, chunk + 1.0, chunk, silent)])


def test_a_file_is_another_one_once_it_was_written_anew(tmp_path: Path) -> None:
    path = tmp_path / "trace"
    path.touch()
    before = digest(path)
    os.utime(path, (1, 1))
    assert digest(path) != before


def test_it_is_made_once_and_each_gets_a_copy(tmp_path: Path) -> None:
    made = list[float]()

    def law(number: float) -> list[float]:
        made.append(number)
        return [number]

    first, other = (_once(law, {}, tmp_path) for _ in range(2))  # as two workers have it
    first(1.0).append(2.0)
    assert other(1.0) == [1.0] and made == [1.0]
    assert other(2.0) == [2.0] and made == [1.0, 2.0]


def test_what_no_pickle_takes_is_made_once_in_each_process(tmp_path: Path) -> None:
    made = list[float]()

    def law(number: float) -> Callable[[], float]:
        made.append(number)
        return lambda: number

    first = _once(law, {}, tmp_path)
    assert first(1.0)() == first(1.0)() == 1.0 and made == [1.0]
    assert first(2.0)() == 2.0 and made == [1.0, 2.0]


def test_who_changes_the_program_does_not_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = list[float]()
    apart, with_all = (_once(made.append, tests, tmp_path) for tests in (globals(), {}))
    with_all(1.0)
    apart(1.0)
    apart(1.0)
    assert made == [1.0, 1.0], "once for all, once for this test"
    monkeypatch.setenv("PYTEST_CURRENT_TEST", "")
    apart(1.0)
    assert made == [1.0, 1.0]


def test_the_folder_is_that_of_the_run() -> None:
    assert Path(os.environ[OF_RUN]).is_dir()
