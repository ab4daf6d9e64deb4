"""Designed motions against the paper's sweep, same time and limits, on random booms.

The design knows what a short sweep has taught, and estimates of load, mass and friction.  What it
predicted is then held against the true machine.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.campaign.excitation import NUMBERS, Outcome, outcome
from tests.campaign.report import leave

pytestmark = pytest.mark.campaign

FREE = 0.0  # V: nothing is declared to be shut, as in the paper
BASIS = f"{len(NUMBERS)} random booms, 80 s, supply 60 to 100 %"
BLOCKS, ERROR, LEAK, RIGHT = 1.5, 0.5, 100.0, 1.5
CHAMBERS = "a", "b"


def machines(safe_v: float = 1.0) -> list[Outcome]:
    return [outcome(number, safe_v) for number in NUMBERS]


def test_the_designed_motion_keeps_its_limits_on_the_true_machine() -> None:
    broken = {o.number: [k for k, kept in o.kept.items() if not kept] for o in machines()}
    count = sum(not names for names in broken.values())
    leave("Designed motion keeps every limit on the true machine", f"{count}", "all", BASIS)
    assert not any(broken.values()), broken


def test_valid_blocks() -> None:
    ratios = [o.blocks for o in machines()]
    median = float(np.median(ratios))
    leave("Valid blocks, designed / swept sine", f"{median:.2f}", f">= {BLOCKS}", BASIS)
    assert median >= BLOCKS, ratios


@pytest.mark.xfail(strict=True, reason="measured 0.50 to 0.73, median 0.62")
def test_median_standard_error() -> None:
    """Over the blocks that both motions visit."""
    ratios = [o.error for o in machines()]
    median = float(np.median(ratios))
    leave("Median standard error, designed / swept sine", f"{median:.2f}", f"<= {ERROR}", BASIS)
    assert median <= ERROR, ratios


def test_smallest_external_leak() -> None:
    """Where the map is free; with valves declared shut below 1 V the sweep sees the leak, too."""
    for safe_v, name in ((FREE, "free maps"), (1.0, "valves declared shut below 1 V")):
        gains = [o.leak(c) for o in machines(safe_v) for c in CHAMBERS]
        figure = f"{np.median(gains):.0f} (least {min(gains):.0f})"
        must = f">= {LEAK:.0f}" if safe_v == FREE else ""
        leave(f"Smallest external leak, swept sine / designed, {name}", figure, must, BASIS)
        if safe_v == FREE:
            assert np.median(gains) >= LEAK, gains


@pytest.mark.parametrize(
    ("safe_v", "name"),
    [(1.0, "valves declared shut below 1 V"), (FREE, "free maps")],
)
def test_predicted_detection_limit(safe_v: float, name: str) -> None:
    """What `rtid diagnose` says of the true machine's record, over what was predicted before."""
    ratios = [o.right(c) for o in machines(safe_v) for c in CHAMBERS]
    figure = f"{min(ratios):.2f} to {max(ratios):.2f}"
    leave(f"Detection limit of the leak, found / predicted, {name}", figure, f"{RIGHT}", BASIS)
    assert max(*ratios, *(1 / r for r in ratios)) <= RIGHT, ratios
