"""Designed motions on random booms: predicted before, found on the true machine, and the sweep."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rtid.diagnose.diagnosis import search
from rtid.diagnose.report import diagnosis
from rtid.estimator.estimator import to_chunk
from rtid.excite.design import candidates, design
from rtid.excite.limits import Limits
from rtid.excite.prediction import Prediction, assess, median_ratio
from rtid.excite.selection import D_OPTIMAL
from rtid.exciting import limits_of, machine_of, section_of
from rtid.model import FloatArray, Model
from rtid.paper.boom import SWEEP_S, sweep
from rtid.project import load
from rtid.sim.motion import Motion
from rtid.sim.plant import Plant
from rtid.sim.run import P_A, P_B, U, V, X, simulate
from tests.excite.machines import machine, motion, write_project

SEE = "external_leakage_laminar"
NUMBERS = (3, 5, 7, 8, 9, 11)


@dataclass(frozen=True)
class Outcome:
    """One machine: predictions on the nominal, findings on the true one, sweep and design.

    limits_found: by `rtid diagnose` from the designed motion, by chamber; kept: every limit, on the
    true machine.
    """

    number: int
    predicted: Prediction
    optimal: Prediction | None
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
        return self.limits_found[where] / self.predicted.limit(SEE, where)


@cache
def outcome(
    number: int, safe_v: float = 1.0, varied: bool = True, optimal: bool = False
) -> Outcome:
    """Design for one machine from its project file, and run it on the true one."""
    plant = machine(number)
    with TemporaryDirectory() as folder:
        more = {} if varied else {"supply_mpa": [8.499999, 8.5]}
        project = load(write_project(Path(folder), plant, number, safe_v=safe_v, **more))
        nominal = machine_of(project, section_of(project))
    limits = limits_of(section_of(project))
    pool = candidates(nominal, limits, (SEE,))
    found = design(nominal, limits, None, pool)
    best = design(nominal, limits, None, pool, D_OPTIMAL) if optimal else None
    model = nominal.model
    chunk, signals = _run(plant, model, motion(found.reference), number, found.duration_s)
    swept, _ = _run(plant, model, sweep, number, SWEEP_S)
    told = diagnosis(search(model, chunk, chunk))
    return Outcome(
        number,
        found.predicted(),
        best.predicted("D-optimal", effects=False) if best else None,
        assess(model, swept, "sweep"),
        assess(model, chunk, "designed"),
        {u.where: u.detection_limit or np.inf for u in told.not_found if u.effect == SEE},
        _kept(limits, signals),
    )


def _run(
    plant: Plant, model: Model, moved: Motion, seed: int, duration_s: float
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
