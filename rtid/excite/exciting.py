"""Design the motion for a project: its [excite] section, what is learned so far, and the CSV."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtid.effects.page import is_zero
from rtid.errors import RtidError, door
from rtid.excite.design import Design, design
from rtid.excite.driving import OFFSET, SHUT, STEP_S, SUPPLY, V_REF, X_REF
from rtid.excite.excitable import start
from rtid.excite.machine import DrivenMachine
from rtid.excite.motion_limits import Limits
from rtid.excite.prediction import Prediction, assess, median_ratio
from rtid.excite.selection import D_OPTIMAL
from rtid.excite.stops import against_stops, with_rests
from rtid.excite.sweep import swept_sine
from rtid.plain import FloatArray, Progress, plain, silent
from rtid.project import Project

SCHEMA = 1


class NothingMissingError(RtidError):
    """What is learned already leaves nothing that a designed motion would tell."""

    exit_code = 4


@dataclass(frozen=True)
class Excited:
    """A design with what it will tell, beside the paper's sweep and a D-optimal choice.

    worth, tried: how many segments are worth running by what is learned, of how many.
    """

    project: Project
    design: Design
    predictions: tuple[Prediction, ...]
    worth: int
    tried: int

    @property
    def designed(self) -> Prediction:
        """What the designed motion will tell."""
        return self.predictions[0]

    @property
    def sweep(self) -> Prediction:
        """What the paper's sweep would tell."""
        return self.predictions[1]


@door
def excite(
    project: Project,
    see: Sequence[str] = (),
    after: str | Path | None = None,
    compare: bool = True,
    progress: Progress = silent,
    **changes: Any,
) -> Excited:
    """Design the motion for a project.

    see: effects to become visible; after: snapshot or trace that tells what is learned; compare:
    also choose D-optimally; changes: of the limits, by the names of `Limits`.  Raises RtidError.
    """
    learned = None if after is None else Path(after)
    begun = start(project, see, learned, lambda what, share: progress(what, 0.6 * share), **changes)
    machine, limits, pool = begun.machine, begun.limits, begun.worth
    if not pool:
        raise NothingMissingError(f"by {begun.taught_by}, no segment tells much more")
    progress("choosing", 0.6)
    wanted = (*see, *(project.sections.excite.see if project.sections.excite else ()))
    rests = against_stops(limits, machine) if any(is_zero(name) for name in wanted) else None
    before_s = rests.duration_s if rests is not None else 0.0
    designed = design(machine, limits.without(before_s), begun.known, pool)
    if rests is not None:
        designed = with_rests(designed, rests, limits)
    progress("predicting", 0.75)
    predictions = [designed.predicted(), _swept(machine, limits)]
    if compare:
        progress("comparing", 0.9)
        other = design(machine, limits, begun.known, pool, D_OPTIMAL)
        predictions.append(other.predicted("D-optimal"))
    progress("done", 1.0)
    return Excited(project, designed, tuple(predictions), len(pool), len(begun.pool))


def _swept(machine: DrivenMachine, limits: Limits) -> Prediction:
    chunk = machine.measured(machine.run(swept_sine(machine, limits)), 1)
    return assess(machine.model, chunk, "paper's sweep")


COLUMNS = (
    "t_s", "x_ref_m", "v_ref_mps", "command_offset_v", "p_supply_set_pa", "valves_shut",
    "expected_x_m", "expected_u_v",
)  # fmt: skip


def write_csv(path: Path, designed: Design) -> None:
    """The reference for the controller, one row per millisecond, beside what is expected.

    Where valves_shut is 1 the controller rests and the command is zero.
    """
    places, r = designed.machine.places, designed.reference
    x, u = (designed.machine.signal(designed.expected, k) for k in (places.x, places.u))
    t_s = STEP_S * np.arange(len(r))
    table = np.column_stack(
        [t_s, r[:, X_REF], r[:, V_REF], r[:, OFFSET], r[:, SUPPLY], r[:, SHUT], x, u]
    )
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows([[f"{value:.7g}" for value in row] for row in table])


def read_csv(path: Path) -> FloatArray:
    """The reference (n, 5), SI, of a file that `write_csv` wrote, columns as `excite.driving`."""
    table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    reference = np.zeros((len(table), 5))
    reference[:, [X_REF, V_REF, OFFSET, SUPPLY, SHUT]] = table[:, 1:6]
    return reference


def as_json(excited: Excited) -> dict[str, Any]:
    """Plain JSON types, SI units in the names; numbers that are not finite are null."""
    names = [edge.name for edge in excited.design.machine.model.edges]
    return {
        "schema": SCHEMA,
        "duration_s": excited.design.duration_s,
        "segments": [
            {"name": c.segment.name, "duration_s": c.segment.duration_s}
            for c in excited.design.segments
        ],
        "extremes": [e._asdict() | {"is_kept": e.is_kept} for e in excited.design.extremes],
        "predictions": [plain(_predicted(p, names)) for p in excited.predictions],
        "median_sd_ratio_to_sweep": plain(median_ratio(excited.designed, excited.sweep)),
        "segments_worth_running": excited.worth,
        "segments_tried": excited.tried,
    }


def _predicted(p: Prediction, names: list[str]) -> dict[str, Any]:
    return {
        "motion": p.name,
        "duration_s": p.duration_s,
        "valid_blocks": p.valid,
        "beta_pa": p.beta_pa.tolist(),
        "beta_sd_pa": p.beta_sd_pa.tolist(),
        "limits": [
            {"effect": x.effect, "where": x.where, "detection_limit": x.value, "unit": x.unit}
            for x in p.limits
        ],
        "blocks": [
            {"edge": names[b.edge], "i": b.i, "j": b.j, "rows": b.rows, "sd_share": b.sd,
             "mean_sd_share": b.mean_sd, "valid": b.valid}
            for b in p.blocks
        ],
    }  # fmt: skip
