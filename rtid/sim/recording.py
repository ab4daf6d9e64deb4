"""A simulated record as files beside each other: trace, truth, and the user's project file."""

from __future__ import annotations

import json
from pathlib import Path

from rtid.errors import door
from rtid.sim.bus import run_frames
from rtid.sim.declare import declared_model
from rtid.sim.demand import parts_s
from rtid.sim.project_file import project_text
from rtid.sim.run import Run
from rtid.sim.run_files import START_US, truth_of, write_log, write_table

TABLE_SUFFIX = ".parquet"


@door
def write_run(trace: str | Path, run: Run, seed: int, motion: str) -> list[Path]:
    """Write trace, truth (.truth.json) and project (.toml); their paths."""
    trace = Path(trace)
    if trace.suffix == TABLE_SUFFIX:
        write_table(trace, run)
    else:
        write_log(trace, run_frames(run, start_us=START_US))
    truth, project = trace.with_suffix(".truth.json"), trace.with_suffix(".toml")
    facts = {"seed": seed, "motion": motion} | truth_of(run.plant)
    truth.write_text(json.dumps(facts, indent=1) + "\n", "utf-8")
    model = declared_model(run.plant, sensors=run.sensors, seed=seed)
    text = project_text(model, run.plant.constants.stroke_m, "simulated cylinder")
    project.write_text(text + _record(run, motion), "utf-8")
    return [trace, truth, project]


def _record(run: Run, motion: str) -> str:
    spans = parts_s(motion, len(run.samples) * 1e-3)
    lines = [f"{key} = [{start:g}, {stop:g}]" for key, (start, stop) in spans.items()]
    return "\n".join(["", "[record]", *lines, ""])
