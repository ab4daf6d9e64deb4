"""A comparison in plain JSON types: SI units, NaN is null; every figure that text or pictures show.

Time series at the rate of the rows are not in it: `rtid compare --table` writes them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rtid.compare import (
    Comparison,
    Correlation,
    Cusum,
    Dependence,
    Deviation,
    Examination,
    Simulation,
    sample_errors,
)
from rtid.model import Machine
from rtid.plain import plain

if TYPE_CHECKING:
    from rtid.study.compared import Held, TraceComparison

SCHEMA = 2
POINTS = 500  # of a CUSUM


def as_json(comparison: TraceComparison) -> dict[str, Any]:
    """The comparison in plain JSON types, SI units; NaN is null."""
    solution = comparison.replay.fit.solution
    return {
        "schema": SCHEMA,
        "trace": str(comparison.replay.trace.path),
        "project": str(comparison.replay.project.path),
        "chambers": [chamber.name for chamber in comparison.replay.model.chambers],
        "rho_of_fit": solution.rho,
        "maps": [_held(comparison.replay.model, tested) for tested in comparison.held],
        "blocks": [plain(vars(row)) for row in comparison.blocks],
        "blocks_by_part": {
            title: [plain(vars(row)) for row in rows]
            for title, rows in comparison.blocks_of.items()
        },
        "differences": [deviation(d) for d in comparison.deviations],
        "differences_by_map": {
            name: [deviation(d) for d in rows] for name, rows in comparison.deviations_of.items()
        },
    }


def _held(model: Machine, tested: Held) -> dict[str, Any]:
    parts = {}
    for title, part in tested.parts.items():
        errors = [plain(vars(e)) | {"rms": e.rms} for e in sample_errors(model, part)]
        parts[title] = _equation(part) | ({"samples": errors} if errors else {})
        if title in tested.examinations:
            parts[title] |= _examination(tested.examinations[title])
    return {"name": tested.name, "beta_pa": plain(tested.beta_pa), "parts": parts}


def _equation(part: Comparison) -> dict[str, Any]:
    some = len(part.t_s) > 0
    return {
        "rows": len(part.t_s),
        "flow_rms_m3s": plain(part.flow_rms_m3s) if some else None,
        "residual_rms_m3s": plain(part.residual_rms_m3s) if some else None,
        "residual_share_of_rms_flow": plain(part.residual_share) if some else None,
        "innovation_variance": plain(part.rho),
        "share_of_time_by_status": part.shares,
    }


def _examination(examination: Examination) -> dict[str, Any]:
    return {
        "simulations": {name: _simulation(s) for name, s in examination.simulations.items()},
        "no_free_run": examination.no_free_run or None,
        "residual_against": [_dependence(d) for d in examination.signals],
        "residual_by_direction": _dependence(examination.direction),
        "residual_over_time": _dependence(examination.time),
        "correlations": [_correlation(c) for c in examination.correlations],
        "cusum": [_cusum(c) for c in examination.cusums],
    }


def _simulation(s: Simulation) -> dict[str, Any]:
    return {
        "restart_every_s": s.period_s if np.isfinite(s.period_s) else None,
        "fit_percent": plain(s.fit_percent),
        "rms_pa": plain(s.rms_pa),
        "samples": int(s.predicted.sum()),
        "stops": s.stops,
        "share_beyond_the_grid": s.beyond_share,
    }


def _dependence(d: Dependence) -> dict[str, Any]:
    return {key: plain(value) for key, value in vars(d).items()}


def _correlation(c: Correlation) -> dict[str, Any]:
    shares = {"outside": c.outside, "outside_at_negative_lags": c.feedback}
    return {key: plain(value) for key, value in vars(c).items()} | shares


def _cusum(c: Cusum) -> dict[str, Any]:
    step = max(1, len(c.t_s) // POINTS)
    arrays = {key: plain(vars(c)[key][::step]) for key in ("t_s", "value", "boundary")}
    words = {key: vars(c)[key] for key in ("chamber", "level", "crosses_s", "change_s")}
    return words | {"largest_share_of_boundary": c.largest} | arrays


def deviation(d: Deviation) -> dict[str, Any]:
    """One edge's map beside a reference."""
    return {
        "edge": d.edge,
        "u_v": plain(d.w_v),
        "dp_pa": plain(d.dp_pa),
        "flow_m3s": plain(d.flow_m3s),
        "sd_m3s": plain(d.sd_m3s),
        "reference_m3s": plain(d.reference_m3s),
        "status": d.status.tolist(),
    }
