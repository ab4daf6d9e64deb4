"""The loop over samples counts no references: 25 atomic operations per sample cost half of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from firmware_bridge.kernel_parts import UNCOUNTED
from rtid.estimator.state import build
from rtid.kernels.engine import advance
from tests.estimator.cases import draw_case


@pytest.mark.skipif(not UNCOUNTED, reason="this numba counts references everywhere")
def test_nothing_in_the_update_is_counted() -> None:
    case = draw_case(1, n=200)
    build(case.model).advance(case.chunk)
    kept = list(Path(advance.stats.cache_path).glob("engine.advance*.nbc"))
    assert kept
    for file in kept:
        assert b"NRT_incref" not in file.read_bytes()
