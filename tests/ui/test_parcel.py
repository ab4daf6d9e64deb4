"""What goes between page and worker: small things as they are, large arrays in a file both map."""

from __future__ import annotations

from collections.abc import Callable
from multiprocessing import active_children
from pathlib import Path
from queue import Queue
from typing import Any

import numpy as np

from rtid.ui.parcel import LARGE, packed, unread
from rtid.ui.worker import Worker, started

MANY, PATIENCE_S = LARGE // 8 + 1, 120.0


def test_large_arrays_are_mapped_and_small_ones_are_not(tmp_path: Path) -> None:
    value: dict[str, Any] = {"large": np.arange(2.0 * MANY).reshape(-1, 2)}
    value |= {"small": np.arange(3), "word": "x"}
    parcel = packed(value, tmp_path)
    assert len(parcel.content) < LARGE
    taken = parcel.value()
    assert np.array_equal(taken["large"], value["large"]) and taken["word"] == "x"
    assert taken["small"].tolist() == [0, 1, 2]
    assert not taken["large"].flags.owndata and not taken["large"].flags.writeable
    assert not list(tmp_path.iterdir())  # it goes with whoever maps it


def test_several_arrays_lie_one_behind_the_other(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = [rng.normal(size=MANY + k) for k in range(5)]
    arrays += [np.zeros((0, 2)), rng.normal(size=(MANY, 2))[:, 0]]  # empty, and with gaps
    taken = packed(arrays, tmp_path).value()
    assert all(np.array_equal(a, b) for a, b in zip(arrays, taken, strict=True))


def test_what_was_let_go_is_read_again(tmp_path: Path) -> None:
    value = np.arange(2.0 * MANY)
    taken = packed(value, tmp_path).value()
    assert np.array_equal(taken, value)
    unread()
    assert np.array_equal(taken, value)


def test_what_is_small_needs_no_file(tmp_path: Path) -> None:
    parcel = packed(("a", 1), tmp_path)
    assert parcel.file is None and parcel.value() == ("a", 1)
    assert not list(tmp_path.iterdir())


def test_a_job_that_nobody_waits_for_any_more_is_not_heard_of(tmp_path: Path) -> None:
    """The next one is answered, whatever became of it."""
    done = list[object]()
    calls: Queue[Callable[[], None]] = Queue()
    worker = Worker(calls.put)
    absent = tmp_path / "absent.toml"
    for method, arguments in (("read", (absent, absent)), ("back", (1,))):
        worker.ask(method, *arguments, then=done.append, failed=done.append)
    worker.forget("read")
    while not done:
        calls.get(timeout=PATIENCE_S)()
    assert done == [None]
    worker.stop()


def test_a_process_that_was_begun_ahead_takes_the_first_job_and_is_ended() -> None:
    done = list[object]()
    calls: Queue[Callable[[], None]] = Queue()
    others = set(active_children())  # of pages that other tests have opened
    with started(ahead=True) as worker:
        (process,) = set(active_children()) - others
        worker.on_loop = calls.put
        worker.ask("back", 1, then=done.append, failed=done.append)
        calls.get(timeout=PATIENCE_S)()
        assert set(active_children()) - others == {process}
    assert done == [None] and not process.is_alive()


def test_nothing_is_begun_for_a_page_that_only_looks_on() -> None:
    others = set(active_children())
    with started(ahead=False):
        assert set(active_children()) <= others
