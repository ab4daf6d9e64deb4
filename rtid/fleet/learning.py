"""One trace of a fleet: what it tells, as one row, and its sums; what fails is told in the row.

Sums are those of nominal weights, as on board, so that traces of one declaration add up.
"""

from __future__ import annotations

import io
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rtid.diagnose.report import Diagnosis
from rtid.diagnose.verdict import INSUFFICIENT
from rtid.estimator.estimator import Estimator
from rtid.estimator.sums import Sums
from rtid.fleet.traces import TraceJob
from rtid.project import Project, load
from rtid.study.study import Study
from rtid.trace.reading import NoSamplesError
from rtid.trace.snapshot import FOLD

OURS = ("rtid", "firmware_bridge")  # their own error classes are meant for the user


@dataclass(frozen=True)
class Outcome:
    """A row of the results, and the sums of the trace as bytes (empty where there are none)."""

    job: TraceJob
    row: dict[str, Any]
    sums: bytes = field(default=b"", repr=False)


def outcome(job: TraceJob, with_diagnosis: bool) -> Outcome:
    """Learn from one trace and diagnose it; never raises: a defect is a row, too."""
    start_s = time.process_time()
    row, sums = empty_row(job), b""
    try:
        project = _project(job.project, job.project.stat().st_mtime_ns)
        study = Study(project, job.trace)
        learned, figures = _learned(study)
        row, sums = row | figures, packed(learned)
        if with_diagnosis:
            row |= _verdict(study)
    except Exception as error:  # one trace must not stop the rest
        row |= _told(error)
    row["cpu_s"] = time.process_time() - start_s
    return Outcome(job, row, sums)


def _told(error: Exception) -> dict[str, str]:
    """An error in words: those that are meant for the user as they are, others as a defect."""
    if isinstance(error, OSError) or type(error).__module__.split(".")[0] in OURS:
        return {"error": str(error), "remedy": getattr(error, "remedy", "")}
    return {"error": f"{type(error).__name__}: {error}", "remedy": "a defect: please report it"}


def empty_row(job: TraceJob) -> dict[str, Any]:
    """A row that knows of its job alone."""
    return {
        "key": job.key, "trace": str(job.trace), "machine": job.machine, "digest": "",
        "start_us": 0, "duration_s": 0.0, "rows": 0, "rho": float("nan"), "beta_pa": [],
        "beta_sd_pa": [], "verdict": "", "effects": [], "places": [], "sizes": [], "units": [],
        "heldout_before_pct": float("nan"), "heldout_after_pct": float("nan"), "truncated": False,
        "cpu_s": 0.0, "error": "", "remedy": "",
    }  # fmt: skip


@lru_cache(maxsize=64)
def _project(path: Path, _changed_ns: int) -> Project:
    return load(path)


def _learned(study: Study) -> tuple[Sums, dict[str, Any]]:
    project, trace = study.project, study.read
    estimator = Estimator(study.machine)
    estimator.update(trace.samples)
    solution = estimator.solution()
    return estimator.sums, {
        "digest": project.machine_digest,
        "start_us": int(trace.samples.t_us[0]),
        "duration_s": trace.duration_s,
        "rows": int(solution.counters.get("rows", 0)),
        "rho": float(solution.rho),
        "beta_pa": solution.beta_pa.tolist(),
        "beta_sd_pa": solution.beta_sd_pa.tolist(),
        "truncated": bool(trace.counters.get("truncated", 0)),
    }


def _verdict(study: Study) -> dict[str, Any]:
    """What a diagnosis says; one that is too short for it has been learned from all the same."""
    try:
        return _diagnosed(study.diagnosis())
    except NoSamplesError as error:
        return {"verdict": INSUFFICIENT, "remedy": str(error)}


def _diagnosed(diagnosis: Diagnosis) -> dict[str, Any]:
    sizes = [next(iter(effect.parameters.values())) for effect in diagnosis.found]
    percent = 100.0 / max(diagnosis.rms_flow_m3s, 1e-12)
    return {
        "verdict": diagnosis.verdict,
        "effects": [effect.effect for effect in diagnosis.found],
        "places": [effect.where for effect in diagnosis.found],
        "sizes": [float(size.value) for size in sizes],
        "units": [size.unit for size in sizes],
        "heldout_before_pct": percent * diagnosis.heldout_residual_before_m3s,
        "heldout_after_pct": percent * diagnosis.heldout_residual_after_m3s,
    }


def packed(sums: Sums) -> bytes:
    """Sums as the bytes of an npz file."""
    memory = io.BytesIO()
    arrays: Mapping[str, Any] = {name: getattr(sums, name) for name in FOLD}
    np.savez_compressed(memory, **arrays)
    return memory.getvalue()


def unpacked(content: bytes) -> Sums:
    """The sums that were packed."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        parts = {name: file[name] for name in FOLD}
    return Sums(**parts | {"rows": float(parts["rows"])})
