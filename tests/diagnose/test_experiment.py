"""What a wandering supply would show is foretold from a sweep, and then found by simulation."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose.diagnosis import search
from rtid.diagnose.experiment import foretold, varied_supply
from rtid.diagnose.fit import Fit, fit, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.summary import _experiment
from rtid.diagnose.unseen import not_found
from rtid.model import Edge, Machine
from rtid.plain import FloatArray
from rtid.units import limit
from tests.diagnose.records import record

pytestmark = pytest.mark.hidden_effect
SAID = re.compile(
    r"motion: (?P<effect>\w+) \((?P<where>.+)\) would be seen from (?P<size>.+) "
    r"(?P<way>on|down), instead of (?P<instead>.+)\.$"
)
LEAKS = ("internal_leakage_laminar", "external_leakage_laminar", "external_leakage_turbulent")


def fitted(motion: str) -> Fit:
    model, chunk, _ = record(motion=motion)
    return fit(model, chunk, prepare(model, chunk), Revision())


@pytest.mark.long
def test_detection_limits_of_leaks_are_foretold() -> None:
    """Within a factor of 1.5 of what a record with such a supply then has."""
    swept, varied = fitted("sweep"), fitted("supply")
    leaks = {c.key for c in swept.columns.candidates if c.effect in LEAKS}
    ratios = []
    for candidate, (_, after) in foretold(swept, leaks).items():
        score = varied.regression.score(varied.estimate.used, varied.column(candidate))
        ratios.append(after.sd / score.sd)
    assert len(ratios) == 5
    assert np.abs(np.log(ratios)).max() < np.log(1.5)


def test_what_a_varied_supply_would_show_is_told_in_the_limits_unit() -> None:
    """Of timings and lines shares of a column were told, as if they were sizes without a unit."""
    result = search(*record(seed=4, motion="sweep"))
    listed = {(u.effect, u.where): u for u in not_found(result, ())}
    closed = tuple(replace(u, visible=False) for u in listed.values())
    said = [words for line in _experiment(result, closed) if (words := SAID.search(line))]
    named = {words["effect"] for words in said}
    assert {"line_dynamics", "input_delay", "spool_lag_second_order", "entrained_air"} <= named
    for words in said:
        unseen = listed[words["effect"], words["where"]]
        is_lag = unseen.unit == "rad/s"
        assert unseen.detection_limit is not None
        if not unseen.form:  # another one is told best of a varied supply
            assert words["instead"] == limit(unseen.detection_limit, unseen.unit)
        assert words["way"] == ("down" if is_lag else "on")
        sizes = [float(words[name].split()[0]) for name in ("size", "instead")]
        assert (sizes[0] > sizes[1]) is is_lag


def moved(model: Machine, chunk: FloatArray) -> FloatArray:
    """By how much the command of the first edge moves with a wandering supply."""
    swept = fit(model, chunk, prepare(model, chunk), Revision(), bank=False)
    column, varied = 2 + model.column(model.edges[0].command), varied_supply(swept)
    assert varied is not None
    return np.asarray((varied - chunk)[:, column])


def in_per_cent(edge: Edge) -> Edge:
    """An edge of 10 V of which the command is in per cent."""
    grid = replace(edge.grid, u_v=10.0 * edge.grid.u_v)
    return replace(edge, grid=grid, safe_band_v=10.0 * edge.safe_band_v)


def test_a_command_in_per_cent_is_moved_as_far_as_one_in_volts() -> None:
    """It was moved by 2 % at most."""
    model, chunk, _ = record(motion="sweep")
    chunk = chunk[:8000]
    signals = tuple(replace(s, maximum=1e9, minimum=-1e9) for s in model.signals)
    model = replace(model, signals=signals)
    by_edges = replace(model, edges=tuple(map(in_per_cent, model.edges)))
    in_volts, scaled = moved(model, chunk), chunk.copy()
    for name in {edge.command for edge in model.edges}:
        scaled[:, 2 + model.column(name)] *= 10.0
    parts = 0.5, 0.9, 0.99, 1.0
    in_volts, here = (np.quantile(np.abs(u), parts) for u in (in_volts, moved(by_edges, scaled)))
    assert in_volts[-1] > 0.2 and here == pytest.approx(10.0 * in_volts, rel=0.02)
