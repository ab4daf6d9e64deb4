"""Designed motions on random booms: predicted before, found on the true machine, and the sweep.

A motion that is designed by a data sheet alone, each valve with its own error, has next to nothing
to choose from: chamber pressures balance valves against each other, and those of the sheet's
machine leave the limits where the true ones do not.  So the first seconds are the paper's sweep.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rtid.diagnose.diagnosis import search
from rtid.diagnose.summary import diagnosis
from rtid.estimator.chunk import to_chunk
from rtid.excite.exciting import excite
from rtid.excite.motion_limits import Limits
from rtid.excite.prediction import Prediction, assess, median_ratio
from rtid.kernels.engine import GAP_FLAG
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.project import load
from rtid.sim.boom import SWEEP_S, sweep
from rtid.sim.bus import run_frames
from rtid.sim.demand import Motion
from rtid.sim.run import P_A, P_B, U, V, X, simulate
from rtid.sim.run_files import START_US, write_log
from rtid.sim.simulated_plant import SimulatedPlant
from tests.excite.machines import machine, motion, write_project

SEE = "external_leakage_laminar"
FIRST_S = 20.0  # of the paper's sweep, run in this time; the rest is designed by what it taught
NUMBERS = (21, 22, 23, 24, 25, 26)  # the design was made on others


@dataclass(frozen=True)
class Outcome:
    """One machine: prediction for the designed part, findings for the sweep and for all of it.

    limits_found: by `rtid diagnose` from the designed motion, by chamber; kept: every limit, on the
    true machine.
    """

    number: int
    predicted: Prediction
    sweep: Prediction
    designed: Prediction
    limits_found: dict[str, float]
    kept: dict[str, bool]

    @property
    def blocks(self) -> float:
        """Valid blocks, designed over sweep."""
        return self.designed.valid / self.sweep.valid

    @property
    def error(self) -> float:
        """Median standard error over the blocks that both visit, designed over sweep."""
        return median_ratio(self.designed, self.sweep)

    def leak(self, where: str) -> float:
        """Detection limit of the external leak, sweep over designed."""
        return self.sweep.limit(SEE, where) / self.designed.limit(SEE, where)

    def right(self, where: str) -> float:
        """Detection limit that the diagnosis finds, over the predicted one."""
        return self.limits_found.get(where, np.inf) / self.predicted.limit(SEE, where)


@cache
def outcome(number: int, safe_v: float = 1.0) -> Outcome:
    """Learn from a short sweep, design the rest of the time by it, and run that on the machine."""
    plant = machine(number)
    with TemporaryDirectory() as folder:
        project = load(write_project(Path(folder), plant, number, safe_v=safe_v))
        trace, seen = Path(folder) / "first.blf", simulate(plant, sweep, number + 1, FIRST_S)
        write_log(trace, run_frames(seen, start_us=START_US))
        rest_s = SWEEP_S - FIRST_S
        found = excite(project, (SEE,), trace, compare=False, duration_s=rest_s).design
    model, limits = project.model, found.limits
    first = to_chunk(model, seen.samples, int(seen.samples.t_us[0]))
    second, signals = _run(plant, model, motion(found.reference), number, found.duration_s)
    swept, _ = _run(plant, model, sweep, number, SWEEP_S)
    told = diagnosis(search(model, second, second))
    return Outcome(
        number,
        found.predicted(),
        assess(model, swept, "sweep"),
        assess(model, _joined(first, second), "designed"),
        {u.where: u.detection_limit or np.inf for u in told.not_found if u.effect == SEE},
        _kept(limits, signals),
    )


def _joined(first: FloatArray, second: FloatArray) -> FloatArray:
    """Two records as one, with a gap between them."""
    later = second.copy()
    later[:, 0] += first[-1, 0] + 1.0
    later[0, 1] = int(later[0, 1]) | GAP_FLAG
    return np.concatenate([first, later])


def _run(
    plant: SimulatedPlant, model: Machine, moved: Motion, seed: int, duration_s: float
) -> tuple[FloatArray, FloatArray]:
    """Samples of the true machine, and its noise-free signals."""
    run = simulate(plant, moved, seed, duration_s)
    return to_chunk(model, run.samples, int(run.samples.t_us[0])), run.truth.signals


def _kept(limits: Limits, signals: FloatArray) -> dict[str, bool]:
    x, p = signals[:, X], signals[:, [P_A, P_B]]
    return {
        "stroke": bool(limits.stroke_m[0] <= x.min() and x.max() <= limits.stroke_m[1]),
        "speed": bool(np.abs(signals[:, V]).max() <= limits.speed_mps),
        "command": bool(np.abs(signals[:, U]).max() <= limits.command_v + 1e-3),
        "pressure": bool(limits.pressure_pa[0] <= p.min() and p.max() <= limits.pressure_pa[1]),
    }
