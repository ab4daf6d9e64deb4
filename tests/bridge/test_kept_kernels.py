"""Kept kernels are loaded without the compiler, and by it where that does not go."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from llvmlite import binding as llvm

from firmware_bridge import kept_kernels, kernel_cache
from firmware_bridge.kept_kernels import KEPT, symbols

COMPILER = "numba.np.linalg"  # loaded with all that numba knows
SAID = """
import sys
from pathlib import Path
import numpy as np
from numba import njit
from firmware_bridge.kernel_cache import cached
from tests.bridge.test_kept_kernels import doubled

kernel = cached(Path(sys.argv[1]), doubled)
twice = kernel(np.arange(3.0))
print(sum(kernel.stats.cache_hits.values()), twice.sum())
print("numba.np.linalg" in sys.modules)
"""


def doubled(values):  # type: ignore[no-untyped-def]
    """Allocates, so that references are counted and C functions of numba are called."""
    return np.sin(np.zeros(len(values))) + 2.0 * values


def fresh(code: str, folder: Path) -> list[str]:
    """What a process of its own says."""
    words = [sys.executable, "-c", code, str(folder)]
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=120)
    return done.stdout.split()


def test_this_numba_is_known() -> None:
    """Else all is well but slower and larger: see what has become of numba's libraries."""
    assert KEPT is not None


def test_a_kept_kernel_does_not_wake_the_compiler(tmp_path: Path) -> None:
    first, second = fresh(SAID, tmp_path), fresh(SAID, tmp_path)
    assert first[-3:] == ["0", "6.0", "True"]
    assert second[-3:] == ["1", "6.0", "False"]


LINKS = (
    SAID
    + """
@njit
def outer(values):
    return kernel(values)[1] + 1.0

print(outer(np.arange(3.0)))
"""
)


def test_another_kernel_is_linked_with_a_kept_one(tmp_path: Path) -> None:
    fresh(SAID, tmp_path)
    assert fresh(LINKS, tmp_path)[-1] == "3.0"


@pytest.mark.parametrize("gone", ["symbols", "address"])
def test_what_it_does_not_know_is_left_to_numba(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gone: str
) -> None:
    kernel_cache.cached(tmp_path, doubled)(np.arange(3.0))
    if gone == "symbols":
        monkeypatch.setattr(kept_kernels, "symbols", lambda _: None)
    else:
        monkeypatch.setattr(llvm, "address_of_symbol", lambda _: None)
    kernel = kernel_cache.cached(tmp_path, doubled)
    assert kernel(np.arange(3.0)).sum() == 6.0 and sum(kernel.stats.cache_hits.values()) == 1


def test_the_table_of_symbols() -> None:
    kernel = kernel_cache.cached(None, doubled)
    kernel(np.arange(3.0))
    (made,) = (result.library for result in kernel.overloads.values())
    defined, asked = symbols(made._get_compiled_object()) or (set(), set())
    assert any("doubled" in name for name in defined) and not defined & asked
    assert "NRT_MemInfo_alloc_aligned" in asked and all(map(llvm.address_of_symbol, asked))
    assert symbols(b"MZ and something else") is None
