"""Where kernels are kept: the first place that takes or has them; a change makes a new one."""

from __future__ import annotations

import resource
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from numba import config

from firmware_bridge import kernel_cache
from firmware_bridge.kernel_cache import cache_folder


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Three places, all of which can be written."""
    found = [tmp_path / name for name in ("first", "second", "third")]
    monkeypatch.setattr(kernel_cache, "_places", lambda _: iter(found))
    return found


def closed(monkeypatch: pytest.MonkeyPatch, *shut: Path) -> None:
    open_ = kernel_cache._is_writable
    monkeypatch.setattr(kernel_cache, "_is_writable", lambda f: f.parent not in shut and open_(f))


def source(folder: Path, text: str) -> Path:
    path = folder / "source.py"
    path.write_text(text)
    return path


def test_a_change_of_any_source_is_another_folder(tmp_path: Path, places: list[Path]) -> None:
    before = cache_folder("k", tmp_path, [source(tmp_path, "a = 1")])
    after = cache_folder("k", tmp_path, [source(tmp_path, "a = 2")])
    assert before != after and before is not None and before.parent == places[0]


def test_the_next_place_where_one_is_closed(
    tmp_path: Path, places: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    closed(monkeypatch, places[0])
    found = cache_folder("k", tmp_path, [source(tmp_path, "")])
    assert found is not None and found.parent == places[1]


def test_a_full_one_that_is_closed_is_copied(
    tmp_path: Path, places: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = [source(tmp_path, "")]
    full = cache_folder("k", tmp_path, sources)
    assert full is not None
    (full / "engine").mkdir()
    (full / "engine" / "advance.nbi").write_text("index")
    closed(monkeypatch, *places)
    copy = cache_folder("k", tmp_path, sources)
    assert copy is not None and copy != full
    assert (copy / "engine" / "advance.nbi").read_text() == "index"
    shutil.rmtree(copy.parent)  # else it goes when the process ends


def test_nowhere_is_told(
    tmp_path: Path, places: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    closed(monkeypatch, *places)
    with pytest.warns(UserWarning, match="NUMBA_CACHE_DIR"):
        assert cache_folder("k", tmp_path, [source(tmp_path, "")]) is None
    kernel = kernel_cache.cached(None, lambda x: x + 1)
    assert kernel(1) == 2


def test_the_setting_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "set"))
    found = cache_folder("k", tmp_path, [source(tmp_path, "")])
    assert found is not None and found.parent == tmp_path / "set"


def added(x: float) -> float:
    return x + 1.0


@contextmanager
def compiling(folder: Path) -> Iterator[tuple[threading.Thread, list[float]]]:
    """A thread that needs the kernel while somebody else holds it."""
    result: list[float] = []
    kernel = kernel_cache.cached(folder, added)
    needs = threading.Thread(target=lambda: result.append(kernel(1.0)))
    with kernel_cache.alone(kernel_cache.lock_of(folder, added)):
        needs.start()
        yield needs, result
    needs.join(60.0)


def test_a_kernel_waits_for_who_compiles_it(tmp_path: Path) -> None:
    with compiling(tmp_path) as (needs, result):
        time.sleep(1.0)
        assert needs.is_alive() and not list(tmp_path.rglob("*.nbc"))
    assert result == [2.0] and len(list(tmp_path.rglob("*.nbc"))) == 1


def test_a_kernel_does_not_wait_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "WAIT_S", 0.1)
    with compiling(tmp_path) as (needs, result):
        needs.join(60.0)
        assert result == [2.0]


def test_who_comes_second_compiles_nothing(tmp_path: Path) -> None:
    first, second = (kernel_cache.cached(tmp_path, added) for _ in range(2))
    assert first(1.0) == second(1.0) == 2.0
    assert (first.stats.cache_misses, second.stats.cache_misses) == ({first.signatures[0]: 1}, {})


def test_a_kernel_that_a_full_disk_cannot_keep_runs_all_the_same(tmp_path: Path) -> None:
    """Else the daemon's helper would end there, and again after each start."""
    kernel = kernel_cache.cached(tmp_path, added)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        with pytest.warns(UserWarning, match="cannot be kept"):
            assert kernel(1.0) == 2.0
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.rglob("*.nbc"))
    again = kernel_cache.cached(tmp_path, added)  # there is room again
    assert again(1.0) == 2.0 and list(tmp_path.rglob("*.nbc"))
