"""A line between valve and chamber is named as a whole, with its sensor at either end."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.diagnose.diagnosis import search
from rtid.diagnose.report import FoundEffect
from rtid.diagnose.summary import diagnosis
from rtid.effects.laws.lines import AT_CYLINDER, AT_VALVE, is_sampled
from rtid.sim.extra_flows import HOSE_AREA_M2, INERTANCE_KGPM5
from rtid.sim.random_plants import draw
from tests.diagnose.records import record

INERTANCE, SEED = 2.4e7, 3  # 3.7 m of hose
ENDS = [
    ("line_dynamics", AT_CYLINDER),
    pytest.param("line_dynamics_seen_at_valve", AT_VALVE, marks=pytest.mark.long),
]


def true_line() -> tuple[float, float]:
    """Half of its volume, m3, and 1 / sqrt(I C), rad/s."""
    volume = 0.5 * INERTANCE / INERTANCE_KGPM5 * HOSE_AREA_M2
    return volume, float(np.sqrt(draw(SEED).beta_pa / (INERTANCE * volume)))


def named(effect: str) -> FoundEffect:
    said = diagnosis(search(*record(effect, INERTANCE, SEED)))
    assert said.verdict == "missing"
    assert said.heldout_residual_after_m3s < 0.7 * said.heldout_residual_before_m3s
    assert said.beta_pa == pytest.approx([draw(SEED).beta_pa] * 2, rel=0.1)
    (line,) = said.found
    return line


@pytest.mark.long
@pytest.mark.parametrize(("effect", "end"), ENDS)
def test_a_line_is_named_with_what_it_is(effect: str, end: str) -> None:
    line, (volume, radps) = named(effect), true_line()
    assert (line.effect, line.where, line.cannot_be_told_from) == ("line_dynamics", "both", ())
    truths = (end, radps, 0.06), ("volume", volume, 0.2), ("inertance", INERTANCE, 0.3)
    for name, true, within in truths:
        value = line.parameters[name]
        assert value.value == pytest.approx(true, rel=within)
        assert abs(value.value - true) < 2.0 * value.std


@pytest.mark.parametrize(
    ("rate_hz", "radps", "is_seen"),
    [(1000, 700, True), (200, 300, True), (200, 450, False), (50, 130, False)],
)
def test_a_line_that_rings_between_the_samples_is_none(
    rate_hz: int, radps: float, is_seen: bool
) -> None:
    """Of a healthy machine at 50 Hz lines of 450 to 825 rad/s were named."""
    view: Any = SimpleNamespace(dt_s=np.full(9, 1.0 / rate_hz))
    assert is_sampled(radps, view) == is_seen
