"""What weighs the rows of a record: the slopes of its own map, in dp and in the command."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rtid.estimator.record import refined, summed
from rtid.estimator.solution import Sketch, sketch
from rtid.estimator.state import nominal_weights, variance
from rtid.estimator.track import pressure_drop
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.sim.random_plants import draw
from tests.diagnose.records import record

STEP_V, STEP_PA = 1e-3, 100.0


@cache
def sketched(seed: int = 3) -> tuple[Machine, FloatArray, Sketch]:
    model, chunk, _ = record(seed=seed)
    return model, chunk, sketch(model, summed(model, chunk))


@pytest.mark.parametrize("seed", [3, 7, 11])
def test_slopes_are_those_of_the_valves_in_both_directions(seed: int) -> None:
    """Beside the plant's own laws, by differences, at the points of the record."""
    model, chunk, said = sketched(seed)
    plant, off = draw(seed), []
    for edge, first in zip(model.edges, model.first_cells, strict=True):
        w = edge.direction * chunk[:, 2 + model.column(edge.command)]
        dp = pressure_drop(model, edge, chunk[:, 2:])
        i, j = (
            np.searchsorted(border, at, side="right") - 1
            for border, at in ((edge.grid.u_v, w), (edge.grid.dp_pa, dp))
        )
        by_w = plant.flow(edge.name, w + STEP_V, dp) - plant.flow(edge.name, w - STEP_V, dp)
        by_dp = plant.flow(edge.name, w, dp + STEP_PA) - plant.flow(edge.name, w, dp - STEP_PA)
        for k, cell in enumerate(said.cells):
            here = first + i * edge.grid.shape[1] + j == cell
            if np.count_nonzero(here) > 300 and said.flow_m3s[k] > 2e-5:
                true = np.sqrt(np.mean(by_w[here] ** 2)) / (2 * STEP_V)
                steep = np.sqrt(np.mean(by_dp[here] ** 2)) / (2 * STEP_PA)
                off.append((said.gain[k] / true - 1.0, said.slope[k] / steep - 1.0))
    assert len(off) > 10
    assert np.abs(np.median(off, axis=0)).max() < 0.03
    assert np.quantile(np.abs(off), 0.75, axis=0).max() < 0.2


def test_noise_of_a_command_counts_as_that_much_more_noise_of_dp() -> None:
    """sd of a flow: (dQ/ddp)^2 var dp + (dQ/dw)^2 var u, as if dp alone had noise."""
    model, _, said = sketched()
    at = next(k for k, s in enumerate(model.signals) if s.name == model.edges[0].command)
    sd_v = 0.02
    signals = [replace(s, noise=sd_v) if k == at else s for k, s in enumerate(model.signals)]
    loud = replace(model, signals=tuple(signals))
    known, less_known = (refined(m, said, m.lag.nominal_s).slopes for m in (model, loud))
    edge = model.edges[0]
    sd_dp = np.sqrt(variance(model, edge.source) + variance(model, edge.sink))
    of_edge = said.cells < model.first_cells[1]
    k = np.flatnonzero(of_edge & np.isfinite(said.flow_m3s))
    cells = said.cells[k]
    expected = np.hypot(known[cells] * sd_dp, said.gain[k] * sd_v)
    assert expected == pytest.approx(less_known[cells] * sd_dp, rel=1e-6, abs=0)
    assert np.mean(less_known[cells] > 1.5 * known[cells]) > 0.5, "it does count"
    untouched = np.setdiff1d(np.arange(model.n_cells), said.cells)
    assert np.array_equal(less_known[untouched], nominal_weights(loud).slopes[untouched])
