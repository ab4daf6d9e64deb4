"""What a motion is designed for: the project's machine, its limits, and what is known before.

What is known before is the prior map of the project, and what a trace or a snapshot has taught.
One rule says what is missing after it, `rtid.excite.design.missing`, for `rtid excite` and for the
coach on board.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rtid.compare.reference import Reference
from rtid.effects import catalogue
from rtid.errors import RtidError
from rtid.estimator.prior import Prior
from rtid.estimator.solution import Solution
from rtid.excite.design import CandidateSegment, Missing, candidates, missing, working_weights
from rtid.excite.driving import Control, Piston
from rtid.excite.information import of_effects
from rtid.excite.known import known_from, prior_cells, take_prior
from rtid.excite.machine import DrivenMachine, rated_map
from rtid.excite.motion_limits import Limits
from rtid.excite.selection import KnownCells
from rtid.maps.prior_map import find_prior, published
from rtid.plain import FloatArray, Progress, silent
from rtid.project import Project
from rtid.project.schema import ExciteSection
from rtid.study.compared import find_reference
from rtid.study.on_board import load_for
from rtid.study.replay import replay
from rtid.units import nearest

SNAPSHOT = ".npz"
ADVICE = (
    "add [excite] to the project file: stroke, speed, command and pressure limits, mass, load, "
    "controller; `rtid excite --help` names them"
)


@dataclass(frozen=True)
class Start:
    """The nominal machine within its limits, the segments that it can follow, what is known.

    missing: by what is known, from what `taught_by` names; None where nothing is known.
    """

    machine: DrivenMachine
    limits: Limits
    pool: Sequence[CandidateSegment]
    known: KnownCells | None
    missing: Missing | None
    taught_by: str

    @property
    def worth(self) -> Sequence[CandidateSegment]:
        """The segments that are worth running."""
        return self.pool if self.missing is None else self.missing.segments


def start(
    project: Project,
    see: Sequence[str] = (),
    after: Path | None = None,
    progress: Progress = silent,
    chunk: FloatArray | None = None,
    **changes: Any,
) -> Start:
    """Try every segment on the machine as it is known, and say what is missing.

    see: effects to become visible, beside those of the project; after: snapshot or trace; chunk:
    samples (n, 2 + signals), SI, that tell of effects what a snapshot does not.  Raises RtidError.
    """
    section = section_of(project)
    see = tuple(dict.fromkeys((*section.see, *see)))
    for name in see:
        if name not in catalogue():
            raise RtidError(f"no effect {name!r}", nearest(name, list(catalogue())), exit_code=2)
    prior = find_prior(project)
    machine, known = _nominal(project, section, see, after, prior)
    if known is not None and see and chunk is not None and len(chunk):
        known.effects.update(of_effects(machine, chunk, see))
    limits = replace(limits_of(section), **changes)
    pool = candidates(machine, limits, see, progress)
    rest = missing(pool, known, working_weights(machine, limits)) if known is not None else None
    notes = [str(after)] if after is not None else []
    notes += [f"the prior {prior.name}"] if prior is not None else []
    return Start(machine, limits, pool, known, rest, " and ".join(notes))


def _nominal(
    project: Project,
    section: ExciteSection,
    see: tuple[str, ...],
    after: Path | None,
    prior: Prior | None,
) -> tuple[DrivenMachine, KnownCells | None]:
    """The nominal machine, and what a prior and a snapshot or a trace have taught of it."""
    if after is None and prior is None:
        return machine_of(project, section), None
    model, solution, chunk = project.model, None, None
    if after is not None:
        solution, chunk = _learned(project, after)
    machine = machine_of(project, section, solution, prior)
    known = KnownCells.nothing(model.n_cells) if solution is None else known_from(model, solution)
    if prior is not None:
        take_prior(known, model, prior, solution.blocks if solution else ())
    if see and chunk is not None:
        known.effects.update(of_effects(machine, chunk, see))
    return machine, known


def _learned(project: Project, after: Path) -> tuple[Solution, FloatArray | None]:
    """What a snapshot or a trace has taught, and the trace's samples."""
    if after.suffix.lower() == SNAPSHOT:
        return load_for(after, project)[0].solution(), None
    trace = replay(project, after)
    return trace.fit.solution, trace.part(trace.identification_s)


def section_of(project: Project) -> ExciteSection:
    """The project's [excite].  Raises RtidError where there is none."""
    if project.sections.excite is None:
        raise RtidError(f"{project.path}: no section [excite]", ADVICE, exit_code=2)
    return project.sections.excite


def limits_of(section: ExciteSection) -> Limits:
    """What the motion may do."""
    usual = section.usual_supply_pa
    return Limits(
        duration_s=section.duration_s,
        stroke_m=section.stroke_m,
        speed_mps=section.speed_mps,
        command_v=section.command_v,
        pressure_pa=section.pressure_pa,
        supply_pa=section.supply_pa or (usual, usual),
        supply_rate_paps=section.supply_pa_per_s,
        offset_v=section.offset_v,
        command_rate_vps=section.command_rate_per_s,
        may_shut=section.may_shut,
        stops_m=section.stops_m,
    )


def machine_of(
    project: Project,
    section: ExciteSection,
    solution: Solution | None = None,
    prior: Prior | None = None,
) -> DrivenMachine:
    """The nominal machine: maps as learned, else of the prior or data sheet, else by rated flow."""
    model, stroke_m = project.model, project.sections.stroke_m
    compliance = np.full(len(model.chambers), 1.0 / model.beta_nominal_pa)
    if solution is not None:
        theta, compliance = published(solution, prior).theta_cells(), solution.compliance
    else:
        reference: Reference | None = find_reference(project, None)
        theta = reference.theta_cells(model) if reference else rated_map(model)
        if prior is not None:
            prior_theta = prior_cells(model, prior)[0]
            theta = np.where(np.isfinite(prior_theta), prior_theta, theta)
    middle_m = 0.5 * stroke_m
    piston = Piston(
        section.mass_kg,
        section.load_n,
        section.load_slope_n_per_m,
        middle_m,
        section.friction_ns_per_m,
        section.friction_n,
    )
    control = Control(
        section.kp_per_s,
        section.volts_per_mps,
        section.deadband_v,
        section.blend_mps,
        section.command_v,
    )
    usual, tank = section.usual_supply_pa, section.tank_pa
    return DrivenMachine(model, theta, compliance, piston, control, stroke_m, usual, tank)
