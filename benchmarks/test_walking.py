"""Sample by sample with a gain that drifts and a lag behind the map: a rate on board, warm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.interleave import Job, side_by_side
from rtid.estimator.estimator import Estimator
from rtid.project import load
from rtid.study.on_board import on_board
from rtid.trace.reading import read_trace
from tests.test_measured import HZ, Rotors
from tests.test_rate import said

SECONDS = 60.0
EFFECTS = ("map_gain_drift", "map_lag")


def test_a_rate_on_board(benchmark: Any, tmp_path: Path) -> None:
    """Four rotors of one map: all of it 100 times as fast as they fly."""
    rng = np.random.default_rng(43)
    table = Rotors.drawn(rng, "behind", knee=0.75).recorded(tmp_path / "f.csv", rng, SECONDS)
    jobs = list[Job]()
    for effect in ("none", *EFFECTS):
        project = tmp_path / f"{effect}.toml"
        said("init", table, "-o", project)
        if effect != "none":
            said("add", effect, table, "-p", project, "--force")
        board = on_board(load(project), lambda _: None)
        samples = read_trace(board, table).samples
        estimator = Estimator(board.model)

        def run(estimator: Estimator = estimator, samples: Any = samples) -> None:
            estimator.reset()
            estimator.update(samples)

        jobs.append(Job(f"effect that is followed: {effect}", run, len(samples.t_us)))
    asked = {job.name: f"{1e4 / HZ:.0f} us" for job in jobs}
    title = "A rate on board, sample by sample"
    side_by_side(benchmark, title, "sample", jobs, jobs[0].name, asked=asked)
