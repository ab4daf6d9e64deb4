"""Row 39: a node whose identifiers, CRCs and counters are right, and whose values are absurd."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtid.compare.foretelling import rated_m3s
from rtid.plain import FloatArray
from rtid.sim.sensing import P_A, P_B
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.snapshot import Generations
from tests.campaign.guarding import Bench, Fault, Simulated
from tests.faults.conftest import Figure
from tests.faults.harness import machine, map_drift

HEALTHY_S, ABSURD_S = 28.0, 12.0


def absurd(values: FloatArray) -> FloatArray:
    """Both chamber pressures anywhere within their range, anew in each sample."""
    changed = values.copy()
    rng = np.random.default_rng(39)
    for column in (P_A, P_B):
        low, high = values[:, column].min(), values[:, column].max()
        changed[:, column] = rng.uniform(low, high, len(values))
    return changed


@pytest.mark.faults
def test_row_39_absurd_values(tmp_path: Path, figure: Figure) -> None:
    """An alarm, and nothing of it is learned: after it the map is the one of before."""
    project = machine().project
    estimator = machine().learned(machine().frames).estimator
    estimator.history = None
    generations, level = (
        Generations(tmp_path, project.digest),
        [0.003 * rated_m3s(project.model)] * 2,
    )
    generations.save(estimator)
    generations.save_baseline(estimator, {"level_m3s": level})
    bench = Bench(SimulatedPlant(), project, machine().catalog, 1, 0.0)
    daemon = Simulated(bench, tmp_path, 100.0)
    run = bench.faulty(Fault((), spoil=absurd), HEALTHY_S, HEALTHY_S + ABSURD_S, 5)
    daemon.hear(run, to_s=HEALTHY_S)
    assert np.isfinite(daemon.learning_s), "the map held has been proven"
    before = daemon.published
    daemon.hear(run, HEALTHY_S)
    figure(39, "alarm after absurd values begin", daemon.alarm_s - HEALTHY_S, 10.0, "s")
    figure(39, "drift of what is published", map_drift(before, daemon.published), 0.01)
    figure(39, "samples learned once it is on", float(daemon.core.learner.learns), 0)
