"""Remake the pictures of docs/tools.md by FMPy and asammdf: part of `make pictures`."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from asammdf import MDF
from fmpy import read_model_description, simulate_fmu

from rtid.maps.fmu import Dynamics, write_fmu
from rtid.plain import FloatArray
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.study import Study
from rtid.tell.recorded import write_recorded
from tools.readme_pictures import shrink

SHOWN_S = 4.0


def driven(path: Path, study: Study) -> tuple[FloatArray, FloatArray]:
    """Time (n,) s and the FMU's pressure in a (n,) Pa, driven by the record's first seconds."""
    model, chunk = study.replay.model, study.replay.chunk
    chunk = chunk[chunk[:, 0] <= SHOWN_S]
    t, values = chunk[:, 0], chunk[:, 2:]
    rates = np.diff(values, axis=0, append=values[-1:]) / float(np.median(np.diff(t)))
    columns = {"time": t}
    for variable in read_model_description(str(path)).modelVariables:
        if variable.causality == "input":
            k = model.column(variable.name.removesuffix("_rate"))
            columns[variable.name] = (rates if variable.name.endswith("_rate") else values)[:, k]
    start = {c.pressure: values[0, model.column(c.pressure)] for c in model.chambers}
    step = float(np.median(np.diff(t)))
    got = simulate_fmu(
        str(path), start_time=t[0], stop_time=t[-1], step_size=step, output_interval=step,
        input=np.array(list(zip(*columns.values(), strict=True)), [(n, float) for n in columns]),
        start_values=start, output=["p_a"],
    )  # fmt: skip
    return got["time"], got["p_a"]


def main(folder: Path) -> None:
    """Learn a simulated machine, export it, and look at it in both programs."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        write_run(work / "run.parquet", simulate(SimulatedPlant(), "rich", 0, 20.0), 0, "rich")
        study = Study(work / "run.toml", work / "run.parquet")
        fit = study.fit
        dynamics = Dynamics(fit.solution.compliance, fit.solution.terms_theta, fit.lag_s)
        write_fmu(work / "machine.fmu", fit.solution.model, study.map, dynamics, {})
        write_recorded(work / "out.mf4", study, {})
        t, pressure = driven(work / "machine.fmu", study)
        figure, axes = plt.subplots(1, 2, figsize=(11, 3.2), layout="constrained")
        chunk = study.replay.chunk[: len(t)]
        measured = chunk[:, 2 + study.replay.model.column("p_a")]
        axes[0].plot(chunk[:, 0], 1e-6 * measured, label="measured", lw=2.0, alpha=0.5)
        axes[0].plot(t, 1e-6 * pressure, label="FMU in FMPy", lw=0.8, color="k")
        axes[0].set(xlabel="s", ylabel="p_a, MPa")
        with MDF(work / "out.mf4") as log:
            for channel in ("measured_a", "residual_a"):
                found = log.get(channel)
                axes[1].plot(found.timestamps, 6e4 * found.samples, label=channel, lw=0.8)
        axes[1].set(xlabel="s", ylabel="L/min", title="out.mf4 in asammdf", xlim=(0, SHOWN_S))
        axes[0].set_title("machine.fmu")
        for ax in axes:
            ax.legend(loc="upper right")
        figure.savefig(work / "tools.png", dpi=150)
        shrink(work / "tools.png", folder / "tools.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
